"""Refinement with planes: what it adds, what it leaves alone, and how the mapper's side is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.reference.palette import ids_of
from tests.tiers import changed
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig, SeedingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.geometry import inverse
from tgslam.map.gaussians import PARAMETERS, GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.mapping.insertion import seed
from tgslam.mapping.quadtree import Quadtree
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.structure_terms import StructureTerms
from tgslam.planes.identity.codes import codes_of, initial_theta, read_ids
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.types import Exposure

CONFIG = StructureConfig()
VIEWS = (0, 20)


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", width=160, height=120, frames=720), seed=0)


def true_keyframe(source: SyntheticSource, index: int, *, with_planes: bool = True) -> Keyframe:
    """In the frame of the first camera, with true labels."""
    result = Keyframe(source.read(index), inverse(source.pose(index)) @ source.pose(0), Exposure(), np.eye(6))
    if with_planes:
        result.show(source.labels(index))
    return result


def true_planes(source: SyntheticSource) -> PlaneTable:
    """In the frame of the first camera."""
    T_wc, planes = source.pose(0), source.planes()
    moved = np.column_stack([planes[:, :3] @ T_wc[:3, :3], planes[:, 3] + planes[:, :3] @ T_wc[:3, 3]])
    return PlaneTable(moved, np.arange(len(planes), dtype=np.int32))


def seeded(source: SyntheticSource) -> GaussianMap:
    """The first view's surface; the plane of each Gaussian is known, its embedding is neutral."""
    frame, view = source.read(0), true_keyframe(source, 0)
    quadtree = Quadtree(frame.colour, frame.depth_m, SeedingConfig(), LossConfig().noise)
    cells = quadtree.leaves(frame.depth_m > 0)
    gaussians = seed(cells, np.zeros((120, 160, 3)), source.camera, view.T_cw, 0, SeedingConfig())
    ids = source.labels(0)[np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)]
    return GaussianMap.from_gaussians(replace(gaussians, plane_id=ids))


def change_ids(view: Keyframe) -> None:
    """A plane turns out to be none."""
    assert view.labels is not None
    shown = view.labels.image()
    view.show(np.where(shown == 0, -1, shown))


def refined(
    source: SyntheticSource, config: StructureConfig | None, steps: int, *, with_planes: bool = True
) -> tuple[GaussianMap, Refiner]:
    """Steps on two views in turn."""
    gaussians = seeded(source)
    refiner = Refiner(gaussians, source.camera, MappingConfig(), LossConfig(), config)
    if with_planes and refiner.structure:
        refiner.structure.know(true_planes(source), 1)
    views = [true_keyframe(source, index, with_planes=with_planes) for index in VIEWS]
    for step in range(steps):
        refiner.step(views[step % len(views)])
    return gaussians, refiner


def share_wrong(source: SyntheticSource, gaussians: GaussianMap, refiner: Refiner) -> float:
    """Of the pixels of the first view."""
    images = refiner.rasterizer.forward(gaussians, np.eye(4), with_embedding=True)
    labels = source.labels(0)
    found = read_ids(images.embedding, images.opacity, np.unique(labels[labels >= 0]), CONFIG)
    return float((found != labels).mean())


def test_without_planes_in_sight_nothing_changes_to_the_bit(source: SyntheticSource) -> None:
    plain, _ = refined(source, None, 4)
    others = [refined(source, CONFIG, 4, with_planes=False)[0]]
    others.append(refined(source, replace(CONFIG, lambda_pgi=0.0, lambda_str=0.0), 4)[0])
    for other in others:
        for name in PARAMETERS:
            np.testing.assert_array_equal(other.host(name), plain.host(name), err_msg=name)


def test_embeddings_learn_the_planes(source: SyntheticSource) -> None:
    start = share_wrong(source, *refined(source, CONFIG, 0))
    first = share_wrong(source, *refined(source, CONFIG, 1))
    later = share_wrong(source, *refined(source, changed(CONFIG, pgi_interval=1), 12))
    assert start > 0.9
    assert first < 0.4
    assert later < 0.2


def test_gaussians_go_to_their_planes(source: SyntheticSource) -> None:
    off, on = (refined(source, replace(CONFIG, lambda_str=weight), 40) for weight in (0.0, 1.0))
    planes = true_planes(source).planes_w
    height = []
    for gaussians, _ in (off, on):
        ids, mean = gaussians.host("plane_id"), gaussians.host("mean")
        distance = np.abs((mean * planes[ids, :3]).sum(1) + planes[ids, 3])[ids >= 0]
        height.append(np.median(distance))
    assert height[1] < 0.8 * height[0]
    assert on[1].structure is not None
    assert on[1].structure.parts["count"] > 0.5 * on[0].count


def test_embeddings_take_part_in_every_nth_step_of_a_keyframe(source: SyntheticSource) -> None:
    terms = StructureTerms(source.camera, changed(CONFIG, pgi_interval=3), 8)
    first, second = (true_keyframe(source, index) for index in VIEWS)
    assert [terms.due(first) is not None for _ in range(7)] == [True, False, False, True, False, False, True]
    assert terms.due(second) is not None
    assert terms.due(true_keyframe(source, 0, with_planes=False)) is None


def test_a_keyframe_with_new_ids_is_prepared_anew(source: SyntheticSource) -> None:
    terms, view = StructureTerms(source.camera, changed(CONFIG, pgi_interval=1), 8), true_keyframe(source, 0)
    before, again = terms.due(view), terms.due(view)
    assert before is again
    change_ids(view)
    assert terms.due(view) is not before


def test_a_keyframe_with_new_ids_takes_part_in_its_next_refinement(source: SyntheticSource) -> None:
    terms, view, other = (
        StructureTerms(source.camera, changed(CONFIG, pgi_interval=3), 8),
        true_keyframe(source, 0),
        true_keyframe(source, VIEWS[1]),
    )
    assert [terms.due(v) is not None for v in (view, other, view, other)] == [True, True, False, False]
    change_ids(view)
    target = terms.due(view)
    assert target is not None
    assert view.labels is not None
    np.testing.assert_array_equal(runtime.to_host(target.ids), view.labels.image())
    assert [terms.due(view) is not None for _ in range(3)] == [False, False, True]  # counted from there
    assert [terms.due(other) is not None for _ in range(2)] == [False, True]  # the others keep their turn


def taken_over(source: SyntheticSource, config: StructureConfig, plane: int) -> float:
    """Share of a plane's Gaussians that lose its identity to a view that measures no depth on it, but all around."""
    gaussians, refiner = refined(source, config, 0)
    gaussians.write("embedding", slice(0, gaussians.count), initial_theta(gaussians.host("plane_id"), config))
    frame, labels = source.read(0), source.labels(0)
    around = replace(frame, index=1, depth_m=np.where(labels == plane, np.float32(0.0), frame.depth_m))
    blind = Keyframe(around, np.eye(4), Exposure(), np.eye(6))
    blind.show(np.where(labels == plane, -1, labels))
    for view in (true_keyframe(source, 0), blind, blind):
        refiner.step(view)
    colours = 1.0 / (1.0 + np.exp(-gaussians.host("embedding")[gaussians.host("plane_id") == plane]))
    return float(np.mean(ids_of(colours, np.unique(labels[labels >= 0]), CONFIG.expert.reading.read_margin) != plane))


def test_a_view_that_shows_only_the_fringe_of_a_plane_takes_less_of_it_over(source: SyntheticSource) -> None:
    config = changed(CONFIG, pgi_interval=1)
    damped, undamped = (
        taken_over(source, changed(config, fringe_share=s), 1) for s in (config.expert.embedding.fringe_share, 0.0)
    )
    assert undamped > 0.15
    assert damped < 0.7 * undamped


def test_new_gaussians_show_their_plane_at_once(source: SyntheticSource) -> None:
    gaussians, refiner = refined(source, CONFIG, 0)
    gaussians.write("embedding", slice(0, gaussians.count), initial_theta(gaussians.host("plane_id"), CONFIG))
    assert share_wrong(source, gaussians, refiner) < 0.2


def test_absorbed_planes_look_like_their_survivors_and_removed_ones_like_none(source: SyntheticSource) -> None:
    table = true_planes(source)
    table.ids[2], table.ids[3] = 1, -1
    table.planes_w[2], table.planes_w[3] = table.planes_w[1], 0.0
    terms = StructureTerms(source.camera, CONFIG, 8)
    terms.know(table, 1)
    codes = np.asarray(terms.codes)
    np.testing.assert_array_equal(codes[3], codes[2])
    np.testing.assert_array_equal(codes[4], codes[0])
    np.testing.assert_array_equal(codes[2], codes_of(1, CONFIG))


def test_the_table_of_a_registry_without_planes_is_empty_of_them() -> None:
    table = PlaneTable.of({}, np.full(3, -1, np.int32))
    np.testing.assert_array_equal(table.ids, [-1, -1, -1])
    assert not table.planes_w.any()
