"""Images, frusta and tracks."""

from __future__ import annotations

import numpy as np
from recordings import (
    make_session,
    stamps,
    write,
)

from smartnav_graph.session.streams import Images, Tracks


def test_images_and_pixel_tracks_lie_over_each_other(tmp_path):
    import cv2

    (tmp_path / "session" / "images").mkdir(parents=True)
    for name in ("0.png", "1.jpg"):
        cv2.imwrite(str(tmp_path / "session" / "images" / name), np.full((20, 30, 3), 80, dtype=np.uint8))
    t = stamps([1.0, 2.0, 3.0])
    images = Images(
        t_ns=t,
        image_id=np.arange(3),
        file=np.array(["0.png", "1.jpg", "absent.jpg"], dtype=object),
        camera=np.array(["cam0"] * 3, dtype=object),
    )
    xy = np.arange(10.0).reshape(5, 2)
    tracks = Tracks(
        t_ns=t[[0, 0, 0, 1, 1]], image_id=np.array([0, 0, 0, 1, 1]), track_id=np.arange(5), xy_n=xy / 100, xy_px=xy
    )
    session = make_session(
        images=images, tracks=tracks, path=tmp_path / "session", pictures=tmp_path / "session/images"
    )
    found = write(tmp_path / "run.rrd", session=session, solution=None, evaluation=None)
    files = [(tmp_path / "session" / "images" / name).read_bytes() for name in ("0.png", "1.jpg")]
    assert [bytes(row[0]) for row in found.rows("/camera/cam0/image", "EncodedImage:blob")] == files
    rows = found.rows("/camera/cam0/image/tracks", "Points2D:positions")
    assert [np.array(row).tolist() for row in rows] == [(xy[:3] + 0.5).tolist(), (xy[3:] + 0.5).tolist()]
    texts = found.texts("/log", "TextLog:text")
    assert "images: 1 files of cam0 not shown (no such JPEG or PNG)" in texts
    assert "Camera cam0" in found.view_names() and "/tracks" not in found.paths
