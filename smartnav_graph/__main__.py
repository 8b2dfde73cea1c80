"""``python -m smartnav_graph`` is ``smartnav``."""

import sys

from smartnav_graph.cli import main

if __name__ == "__main__":
    sys.exit(main())
