"""The map's storage: growth, removal, round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tgslam.map.gaussians import CARRIERS, PARAMETERS, GaussianMap
from tgslam.map.table import Column, Table
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

FIELDS = tuple(Gaussians.__dataclass_fields__)


def numbered(first: int, count: int) -> Gaussians:
    """Rows whose every value tells which row it is."""
    ids = np.arange(first, first + count)
    column = ids[:, None].astype(np.float32)
    return Gaussians(
        mean=column + np.float32([0.1, 0.2, 0.3]),
        log_scale=-column + np.float32([0.0, 0.25, 0.5]),
        quat_wxyz=column + np.float32([1.0, 2.0, 3.0, 4.0]),
        opacity_logit=ids.astype(np.float32) * 0.5,
        colour=column * np.float32([1.0, 2.0, 3.0]),
        embedding=column * np.float32([-1.0, 0.5, 7.0]),
        plane_id=ids.astype(np.int32) - 1,
        birth_keyframe=ids.astype(np.int32) * 3,
    )


def assert_rows(gaussian_map: GaussianMap, ids: list[int]) -> None:
    """The map holds exactly the rows with these numbers, in this order."""
    stored, source = gaussian_map.gaussians(), numbered(0, max(ids, default=0) + 1)
    assert gaussian_map.count == len(stored) == len(ids) <= gaussian_map.capacity
    for name in FIELDS:
        wanted = getattr(source, name)[ids]
        np.testing.assert_array_equal(getattr(stored, name), wanted, err_msg=name)
        assert getattr(stored, name).dtype == wanted.dtype


def test_round_trip() -> None:
    assert_rows(GaussianMap.from_gaussians(numbered(0, 37)), list(range(37)))


def test_the_copy_on_the_host_is_a_copy() -> None:
    gaussian_map = GaussianMap.from_gaussians(numbered(0, 5))
    for name in FIELDS:
        getattr(gaussian_map.gaussians(), name)[:] = 99
    assert_rows(gaussian_map, list(range(5)))


def test_the_map_does_not_alias_what_was_appended() -> None:
    rows = numbered(0, 4)
    gaussian_map = GaussianMap.from_gaussians(rows)
    rows.mean[:] = 99.0
    assert_rows(gaussian_map, [0, 1, 2, 3])


def test_append_doubles_the_capacity() -> None:
    gaussian_map = GaussianMap(4)
    capacities = []
    for first in range(9):
        gaussian_map.append(numbered(first, 1))
        capacities.append(gaussian_map.capacity)
    assert capacities == [4] * 4 + [8] * 4 + [16]
    assert_rows(gaussian_map, list(range(9)))
    assert all(len(gaussian_map.array(name)) == 16 for name in FIELDS)


def test_append_more_than_double() -> None:
    gaussian_map = GaussianMap(2)
    gaussian_map.append(numbered(0, 11))
    assert gaussian_map.capacity == 11
    assert_rows(gaussian_map, list(range(11)))


def test_append_nothing() -> None:
    gaussian_map = GaussianMap.from_gaussians(numbered(0, 3))
    gaussian_map.append(numbered(0, 0))
    assert_rows(gaussian_map, [0, 1, 2])
    assert_rows(GaussianMap.from_gaussians(numbered(0, 0)), [])


@pytest.mark.parametrize("kept", [[], [0, 1, 2, 3, 4, 5], [0], [5], [1, 2, 4]])
def test_keep_compacts_in_order(kept: list[int]) -> None:
    gaussian_map = GaussianMap.from_gaussians(numbered(0, 6))
    gaussian_map.keep(np.isin(np.arange(6), kept))
    assert_rows(gaussian_map, kept)
    gaussian_map.append(numbered(6, 2))
    assert_rows(gaussian_map, [*kept, 6, 7])


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 2**31 - 1)), max_size=8), st.integers(1, 8))
def test_any_sequence_of_append_and_keep(steps: list[tuple[int, int]], capacity: int) -> None:
    gaussian_map, ids, following = GaussianMap(capacity), np.zeros(0, np.intp), 0
    for count, seed in steps:
        gaussian_map.append(numbered(following, count))
        ids = np.concatenate([ids, np.arange(following, following + count)])
        following += count
        mask = np.random.default_rng(seed).random(len(ids)) > 0.3
        gaussian_map.keep(mask)
        ids = ids[mask]
    assert_rows(gaussian_map, ids.tolist())


def test_host_shows_the_rows_in_use() -> None:
    gaussian_map = GaussianMap(16)
    gaussian_map.append(numbered(0, 3))
    for name in FIELDS:
        np.testing.assert_array_equal(gaussian_map.host(name), getattr(numbered(0, 3), name))


# Everything else that is known of a row

OTHERS = ("carriers", "contribution", "views", "guessed", "information", "support", "conflict")


def known(ids: np.ndarray) -> dict[str, np.ndarray]:
    """Values of the other columns that tell which row it is."""
    return {
        "carriers": np.repeat(ids[:, None], CARRIERS, 1).astype(np.int32) + np.arange(CARRIERS, dtype=np.int32),
        "contribution": ids.astype(np.float32) / 3,
        "views": ids.astype(np.int32) + 1,
        "guessed": ids % 3 == 1,
        "information": ids / 7,
        "support": ids.astype(np.int32) * 2,
        "conflict": ids.astype(np.int32) * 5,
    }


@settings(max_examples=20)
@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 2**31 - 1)), max_size=6), st.integers(1, 8))
def test_all_that_is_known_of_rows_stays_in_step(steps: list[tuple[int, int]], capacity: int) -> None:
    gaussian_map, ids = GaussianMap(capacity), np.zeros(0, np.intp)
    gaussian_map.add_columns([Column("own", 2), Column("count", dtype=np.int32, on_host=True)])
    for count, seed in steps:
        first = int(ids.max(initial=-1)) + 1
        new = np.arange(first, first + count)
        gaussian_map.append(numbered(first, count), **known(new), own=np.stack([new, -new], 1))
        ids = np.concatenate([ids, new])
        mask = np.random.default_rng(seed).random(len(ids)) > 0.3
        gaussian_map.keep(mask)
        ids = ids[mask]
    assert_rows(gaussian_map, ids.tolist())
    for name, values in known(ids).items():
        np.testing.assert_array_equal(gaussian_map.host(name), values, err_msg=name)
        assert gaussian_map.host(name).dtype == values.dtype
    np.testing.assert_array_equal(gaussian_map.host("own"), np.stack([ids, -ids], 1))
    np.testing.assert_array_equal(gaussian_map.host("count"), 0)


def test_new_rows_are_followed_by_nothing_of_those_that_left() -> None:
    gaussian_map = GaussianMap(4)
    gaussian_map.append(numbered(0, 4), **known(np.arange(1, 5)))
    gaussian_map.keep(np.zeros(4, bool))
    gaussian_map.append(numbered(0, 3))
    for name in OTHERS[1:]:
        assert not gaussian_map.host(name).any(), name
    np.testing.assert_array_equal(gaussian_map.host("carriers"), np.repeat([[0], [3], [6]], CARRIERS, 1))


def test_wrong_masks_and_columns_are_refused() -> None:
    table = Table([Column("a")], 4)
    table.append(3, {})
    with pytest.raises(ValueError, match=r"mask must have shape \[3\]"):
        table.keep(np.ones(4, bool))
    with pytest.raises(ValueError, match="a column 'a' already"):
        table.add_column(Column("a"))


def test_gradients_have_the_shapes_of_their_parameters() -> None:
    gaussian_map, gradient = GaussianMap(6), MapGradient.zeros(6)
    for name in PARAMETERS:
        assert getattr(gradient, name).shape == getattr(gaussian_map, name).shape
        getattr(gradient, name)[:] = 1.0
    gradient.curvature[:] = 1.0
    gradient.clear()
    assert not any(getattr(gradient, name).any() for name in (*PARAMETERS, "curvature"))
