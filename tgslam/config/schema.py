"""Every setting of a run: one frozen dataclass a section, with defaults, units and allowed ranges in its module."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from tgslam.config.graph_settings import ClosureConfig, LoopConfig
from tgslam.config.input_settings import DatasetConfig, EvaluationConfig, SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig, SeedingConfig
from tgslam.config.plane_settings import PlanesConfig, StructureConfig
from tgslam.config.setting import setting
from tgslam.config.tracking_settings import KeyframeConfig, TrackingConfig


@dataclass(frozen=True)
class Config:
    """The whole of a run's settings."""

    seed: int = setting(0, 0, 2**31 - 1)
    dataset: DatasetConfig = dataclasses.field(default_factory=DatasetConfig)
    synthetic: SyntheticConfig = dataclasses.field(default_factory=SyntheticConfig)
    tracking: TrackingConfig = dataclasses.field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    seeding: SeedingConfig = dataclasses.field(default_factory=SeedingConfig)
    mapping: MappingConfig = dataclasses.field(default_factory=MappingConfig)
    planes: PlanesConfig = dataclasses.field(default_factory=PlanesConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    structure: StructureConfig = dataclasses.field(default_factory=StructureConfig)
    closures: ClosureConfig = dataclasses.field(default_factory=ClosureConfig)
    loops: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
