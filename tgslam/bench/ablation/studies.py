"""What is compared with what: the studies of section 4.4, and those of the parts that the paper does not take out."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One metric of a table."""

    key: str  # of metrics.json
    title: str
    digits: int  # after the point


@dataclass(frozen=True)
class Variant:
    """One row of a table."""

    name: str
    overrides: tuple[str, ...]  # section.key=value; () = as the settings say


@dataclass(frozen=True)
class Study:
    """One table for each input: its variants, the first of which the others are compared with."""

    name: str
    title: str
    common: tuple[str, ...]  # overrides of all variants
    variants: tuple[Variant, ...]
    columns: tuple[Column, ...]
    scenes: tuple[str, ...]  # built-in ones that it runs on unless an input is named

    def overrides(self, variant: Variant) -> tuple[str, ...]:
        """All that a variant sets."""
        return (*self.common, *variant.overrides)

    def fixed_keys(self) -> frozenset[str]:
        """Settings that every variant makes itself: what anybody else says of them would have no effect."""
        return frozenset.intersection(*(keys_of(self.overrides(variant)) for variant in self.variants))


def keys_of(overrides: tuple[str, ...]) -> frozenset[str]:
    """The keys of `section.key=value`."""
    return frozenset(text.partition("=")[0].strip() for text in overrides)


_TRAJECTORY = (Column("ate_rmse_cm", "ATE, cm", 2), Column("ate_rmse_all_cm", "ATE, all frames, cm", 2))
_IMAGES = (
    Column("psnr_db", "PSNR, dB", 2),
    Column("psnr_affine_db", "PSNR, colours fitted, dB", 2),
    Column("ssim", "SSIM", 4),
    Column("lpips", "LPIPS", 3),
    Column("depth_l1_cm", "depth L1, cm", 2),
)
_TRACKED = Column("tracked_fraction", "tracked", 3)
_FLOATERS = Column("floater_share", "floaters", 4)
_CLOSURES = Column("closures", "closures", 1)
_PLANES = Column("plane_pq", "plane PQ", 3)
_FPS = Column("fps", "frames/s", 2)

INTERVAL = Study(
    name="interval",
    title="structure closures at every k-th keyframe (Table 4)",
    common=("closures.formulation=closures", "loops.enabled=false"),
    variants=(
        *(Variant(f"every {k}", ("closures.enabled=true", f"closures.interval={k}")) for k in (4, 10, 25)),
        Variant("never", ("closures.enabled=false",)),
    ),
    columns=(*_TRAJECTORY, *_IMAGES, _CLOSURES, _FPS),
    scenes=("corridor", "room"),
)
STRUCTURE = Study(
    name="structure",
    title="what structure does where there is little texture (Table 5)",
    common=("loops.enabled=false",),
    variants=(
        Variant("off", ("planes.enabled=false",)),
        *(Variant(name, (f"closures.formulation={name}",)) for name in ("closures", "landmarks", "both")),
    ),
    columns=(*_TRAJECTORY, _TRACKED, *_IMAGES, _CLOSURES, _PLANES, _FLOATERS, _FPS),
    scenes=("corridor", "blank"),
)
GATE = Study(
    name="gate",
    title="the texture gate (Eqs. 10, 11)",
    common=(),
    variants=(Variant("on", ("loss.gate=true",)), Variant("off", ("loss.gate=false",))),
    columns=(*_TRAJECTORY, _TRACKED, *_IMAGES, _FLOATERS, _FPS),
    scenes=("blank", "room"),
)
_NO_SSIM = ("loss.weight_ssim=0",)
# tracking weighs its residuals by itself
_NO_GRADIENT = ("loss.weight_grad=0", "tracking.expert.residuals.weight_gradient=0")
TERMS = Study(
    name="terms",
    title="the SSIM and gradient terms of the objective (Eq. 12)",
    common=(),
    variants=(
        Variant("both", ()),
        Variant("no SSIM", _NO_SSIM),
        Variant("no gradient", _NO_GRADIENT),
        Variant("neither", (*_NO_SSIM, *_NO_GRADIENT)),
    ),
    columns=(*_TRAJECTORY, *_IMAGES, _FPS),
    scenes=("room", "corridor"),
)
VIEWPOINTS = Study(
    name="viewpoints",
    title="sparse global viewpoints (section 3.4): which earlier keyframes are refined with the window",
    common=(),
    variants=tuple(Variant(name, (f"mapping.anchors={name}",)) for name in ("structure", "random", "none")),
    columns=(*_TRAJECTORY, *_IMAGES, _CLOSURES, _PLANES, _FPS),
    scenes=("corridor", "room"),
)
RECORDINGS = Study(
    name="recordings",
    title="what recordings that nobody tuned to ask for",
    common=(),
    variants=(
        Variant("all", ()),
        Variant("exposure constant", ("tracking.exposure=none",)),
        Variant("no recognition", ("tracking.recognition=false",)),
        Variant("no closures, no loops", ("closures.enabled=false", "loops.enabled=false")),
        Variant("a Kinect in a room", ("loss.depth_sigma_per_m2=0.0015", "unit_m=1")),
    ),
    columns=(*_TRAJECTORY, _TRACKED, *_IMAGES, _CLOSURES, _FPS),
    scenes=("room", "corridor"),
)
QUALITY = Study(
    name="quality",
    title="time for refinement of the map",
    common=(),
    variants=(
        Variant("1", ("mapping.budget=1",)),
        *(Variant(f"{budget:g}", (f"mapping.budget={budget:g}",)) for budget in (0.5, 2.0, 5.0)),
    ),
    columns=(*_TRAJECTORY, *_IMAGES, _FPS),
    scenes=("room", "corridor"),
)
STUDIES = {study.name: study for study in (INTERVAL, STRUCTURE, GATE, TERMS, VIEWPOINTS, RECORDINGS, QUALITY)}
