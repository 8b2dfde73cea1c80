"""The rotation that lays one set of points on another, and the similarity made of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import best_rotation
from smartnav_graph.evaluation.align import fit_alignment

# Two unrelated sets of points. The expected values were computed once with evo 1.38.1 (umeyama_alignment, with and
# without scale): for the two sets, and for the first set and its mirror image in the xy plane.
X = np.array(
    [
        [0.001, 0.299, -0.274],
        [-0.891, -0.455, -0.992],
        [0.06, 1.34, -0.492],
        [-0.62, 0.49, 0.357],
        [0.105, -0.93, -0.029],
        [0.695, -1.344, -0.458],
    ]
)
Y = np.array(
    [
        [-1.901, -1.29, -1.842],
        [-0.235, -1.267, 0.271],
        [0.157, -0.187, -2.517],
        [-0.539, -0.049, 0.113],
        [-1.53, -0.478, -0.979],
        [-0.809, 1.061, -0.808],
    ]
)
APART = [
    [-0.15711130378121685, 0.3250493878975735, -0.9325550566328931],
    [0.7847820162028394, -0.5321499930646666, -0.31770044369796197],
    [-0.5995275016784237, -0.7817667684857733, -0.1714861347822015],
]
MIRRORED = [
    [0.7253226257884032, -0.12016054709668186, 0.6778410812578726],
    [-0.12016054709668188, 0.9474344870231238, 0.2965288109453382],
    [-0.6778410812578728, -0.29652881094533823, 0.6727571128115274],
]


@pytest.mark.parametrize(
    ("y", "R", "shift", "scaled_shift", "scale"),
    [
        (
            Y,
            APART,
            [-1.0874594436070248, -0.4365000205014511, -1.157419793275206],
            [-1.0292005364382772, -0.4222126242964744, -1.1161114584153773],
            0.7904050086849603,
        ),
        (
            X * [1.0, 1.0, -1.0],
            MIRRORED,
            [0.171521223319886, 0.07503378861097156, 0.42327523993389055],
            [0.10210640044444834, 0.0316185961661941, 0.3963360863740637],
            0.7519610768337327,
        ),
    ],
    ids=["unrelated", "mirrored"],
)
def test_equals_evo(y, R, shift, scaled_shift, scale):
    for method, expected_shift, expected_scale in (("se3", shift, 1.0), ("sim3", scaled_shift, scale)):
        found = fit_alignment(method, X, y)
        assert pytest.approx(np.array(R), abs=1e-12) == found.R
        assert found.t == pytest.approx(expected_shift, abs=1e-12)
        assert found.scale == pytest.approx(expected_scale, abs=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.01, 40.0])
def test_a_similarity_is_recovered(scale):
    R, t = Rotation.from_euler("ZYX", [170.0, -85.0, 100.0], degrees=True).as_matrix(), np.array([3.0, -7.0, 1.0])
    found = fit_alignment("sim3", X, scale * X @ R.T + t)
    assert pytest.approx(R, abs=1e-12) == found.R
    assert found.scale == pytest.approx(scale, rel=1e-12)
    assert found.t == pytest.approx(t, abs=1e-12 * max(scale, 1.0))


def test_three_points_of_a_plane_suffice():
    R = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix()
    found, singular = best_rotation(X[:3], X[:3] @ R.T)
    assert found == pytest.approx(R, abs=1e-12)
    assert singular[2] == pytest.approx(0.0, abs=1e-12)


def test_a_mirror_image_gives_a_rotation():
    found, singular = best_rotation(X, X * [1.0, 1.0, -1.0])
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert singular[2] < 0.0 < singular[1]


@pytest.mark.parametrize("where", [np.zeros(3), np.array([2000.0, -500.0, 100.0])])
def test_points_on_a_line_leave_the_rotation_open(where):
    line = where + np.linspace(-50.0, 50.0, 101)[:, None] * np.array([0.6, 0.0, 0.8])
    R = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix()
    for method in ("se3", "sim3"):
        for truth in (line, line @ R.T, np.random.default_rng(1).normal(size=line.shape)):
            with pytest.raises(SessionError, match="do not determine the rotation"):
                fit_alignment(method, line, truth)
