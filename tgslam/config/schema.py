"""Every setting of a run: one frozen dataclass a section, with defaults, units and allowed ranges in its module.

What only somebody who knows the algorithm can turn is in a section's second tier, `expert`, one dataclass a component.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from tgslam.config.graph_settings import ClosureConfig, LoopConfig
from tgslam.config.input_settings import DatasetConfig, EvaluationConfig, SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig, SeedingConfig
from tgslam.config.plane_settings import PlanesConfig, StructureConfig
from tgslam.config.pose_settings import PosesConfig
from tgslam.config.setting import setting
from tgslam.config.tracking_settings import KeyframeConfig, TrackingConfig


@dataclass(frozen=True)
class SystemConfig:
    """What the system itself reads: settings of how frames become poses, a map and planes."""

    seed: int = setting(0, 0, 2**31 - 1, doc="Seed of all that is random: two runs of one seed are equal.")
    unit_m: float | None = setting(
        None,
        1e-6,
        1e6,
        doc="Settings in metres are for rooms; in a world of another size they count in units of so many m. null: told "
        "from the first frame, 1 for rooms.",
    )
    poses: PosesConfig = dataclasses.field(default_factory=PosesConfig)
    tracking: TrackingConfig = dataclasses.field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    seeding: SeedingConfig = dataclasses.field(default_factory=SeedingConfig)
    mapping: MappingConfig = dataclasses.field(default_factory=MappingConfig)
    planes: PlanesConfig = dataclasses.field(default_factory=PlanesConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    structure: StructureConfig = dataclasses.field(default_factory=StructureConfig)
    closures: ClosureConfig = dataclasses.field(default_factory=ClosureConfig)
    loops: LoopConfig = dataclasses.field(default_factory=LoopConfig)


@dataclass(frozen=True)
class Config(SystemConfig):
    """The whole of a run's settings: besides, where frames come from, and how the run is measured."""

    dataset: DatasetConfig = dataclasses.field(default_factory=DatasetConfig)
    synthetic: SyntheticConfig = dataclasses.field(default_factory=SyntheticConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
