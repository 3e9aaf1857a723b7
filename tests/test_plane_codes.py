"""Mixtures of identities at edges: which of the ids around a pixel its colour shows most of."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.config.plane_settings import StructureConfig
from tgslam.planes.identity.codes import codes_of, unmixed

CONFIG = StructureConfig()


@pytest.mark.parametrize(("share", "expected"), [(0.9, 3), (0.6, 3), (0.4, 7), (0.1, 7)])
def test_a_mixture_of_two_ids_is_the_larger_part(share, expected):
    first, second = codes_of([3, 7], CONFIG)
    colour = share * first + (1.0 - share) * second
    assert unmixed(colour[None], np.array([[-1, 3, 7, 7]]), CONFIG).tolist() == [expected]


@pytest.mark.parametrize(("share", "expected"), [(0.7, 3), (0.3, -1)])
def test_no_plane_may_be_a_part(share, expected):
    assert unmixed(share * codes_of([3], CONFIG), np.array([[-1, 3]]), CONFIG).tolist() == [expected]


def test_what_no_mixture_explains_stays_undecided():
    ids, other = np.array([[-1, 3]]), codes_of([0], CONFIG)
    assert np.linalg.norm(other - codes_of([3], CONFIG)) > 0.5
    assert unmixed(other, ids, CONFIG).tolist() == [-1]
