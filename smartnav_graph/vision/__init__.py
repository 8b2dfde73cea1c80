"""Images -> points, pairs, relative geometry."""
