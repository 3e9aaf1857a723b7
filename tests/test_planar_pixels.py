"""Where guesses of depth continue the plane that they take their depth from."""

import numpy as np

from tgslam.camera import Camera
from tgslam.mapping.planar_pixels import PlanarPixels

CAMERA = Camera(64, 48, 100.0, 100.0, 31.5, 23.5)
HOLE = np.s_[10:20, 30:40]
SEEN_AT = 15 * 64 + 29  # the pixel that all of the hole takes its depth from


def half_seen(normal):
    """A plane 2 m off, seen left of column 30; its depth in the whole image."""
    normal = np.array(normal) / np.linalg.norm(normal)
    exact_m = normal @ (0.0, 0.0, 2.0) / (CAMERA.rays() @ normal)
    seen = np.arange(64)[None, :] < 30
    ids = np.where(seen, 4, -1) * np.ones((48, 1), int)
    pixels = PlanarPixels(
        ids.astype(np.int32),
        np.where(seen, exact_m, 0.0).astype(np.float32),
        np.where(seen[..., None], normal, 0.0).astype(np.float32) * np.ones((48, 1, 1), np.float32),
    )
    return pixels, exact_m, normal


def sources():
    source = np.full((48, 64), -1, np.int64)
    source[HOLE] = SEEN_AT
    return source


def test_guesses_continue_a_plane_and_nothing_else_does():
    pixels, exact_m, normal = half_seen((0.3, 0.2, -1.0))
    continued = pixels.continued(sources(), CAMERA.rays())
    np.testing.assert_allclose(continued.depth_m[HOLE], exact_m[HOLE], rtol=1e-5)
    np.testing.assert_allclose(continued.normals_c[HOLE], np.broadcast_to(normal, (10, 10, 3)), atol=1e-6)
    outside = np.ones((48, 64), bool)
    outside[HOLE] = False
    np.testing.assert_array_equal(continued.depth_m[outside], pixels.depth_m[outside])
    np.testing.assert_array_equal(continued.normals_c[outside], pixels.normals_c[outside])
    np.testing.assert_array_equal(continued.ids, pixels.ids)


def test_a_plane_so_slanted_that_it_runs_away_is_not_continued():
    pixels, exact_m, _ = half_seen((3.0, 0.0, -1.0))
    continued = pixels.continued(sources(), CAMERA.rays())
    far = abs(exact_m / exact_m.ravel()[SEEN_AT] - 1.0)[HOLE] > 0.1
    assert far.any() and not far.all()
    assert (continued.depth_m[HOLE][far] == 0).all() and (continued.depth_m[HOLE][~far] > 0).all()


def test_guesses_from_what_is_on_no_plane_stay_as_they_are():
    pixels, _, _ = half_seen((0.3, 0.2, -1.0))
    source = np.full((48, 64), -1, np.int64)
    source[HOLE] = 15 * 64 + 45
    continued = pixels.continued(source, CAMERA.rays())
    np.testing.assert_array_equal(continued.depth_m, pixels.depth_m)
