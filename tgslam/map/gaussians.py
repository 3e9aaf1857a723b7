"""The map's Gaussians: one table with everything that is known of each of them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tgslam.map.table import Column, Table
from tgslam.ops import rigid
from tgslam.ops.splats import WIDTHS
from tgslam.types import Gaussians

PARAMETERS = tuple(WIDTHS)  # what is differentiated
CARRIERS = 8  # keyframes that a Gaussian follows: twice as many move the map no better, half as many tear it a little

_COLUMNS = (
    *(Column(name, width) for name, width in WIDTHS.items()),
    Column("plane_id", dtype=np.int32),  # -1 = on none
    Column("birth_keyframe", dtype=np.int32),
    Column("carriers", CARRIERS, np.int32),  # keyframes that it follows, see `mapping.carriers`
    Column("contribution"),  # px, since birth the most blend weight in any view
    Column("views", dtype=np.int32),  # rendered with it in sight
    Column("guessed", dtype=np.bool_, on_host=True),  # seeded where no depth was measured
    Column("information", dtype=np.float64, on_host=True),  # 1/m^2, what is known of its depth
    Column("support", dtype=np.int32, on_host=True),  # keyframes whose depth agrees with it
    Column("conflict", dtype=np.int32, on_host=True),  # keyframes that see through it
)
_FIELDS = tuple(Gaussians.__dataclass_fields__)
_FIRST_CAPACITY = 4096


class GaussianMap:
    """Owns the Gaussians. Kernels change parameters in place; rows and all other columns change through here."""

    def __init__(self, capacity: int = _FIRST_CAPACITY) -> None:
        self._table = Table(_COLUMNS, capacity)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianMap:
        """A map that holds these Gaussians, of which nothing else is known."""
        result = cls(max(len(gaussians), 1))
        result.append(gaussians)
        return result

    @property
    def count(self) -> int:
        """Gaussians."""
        return self._table.count

    @property
    def capacity(self) -> int:
        """Rows of each device array, of which [0, count) are in use."""
        return self._table.capacity

    @property
    def mean(self) -> np.ndarray:
        """[capacity, 3] m, world."""
        return self._table.array("mean")

    @property
    def log_scale(self) -> np.ndarray:
        """[capacity, 3] log of the standard deviations, m."""
        return self._table.array("log_scale")

    @property
    def quat_wxyz(self) -> np.ndarray:
        """[capacity, 4] local to world, of any length but zero."""
        return self._table.array("quat_wxyz")

    @property
    def opacity_logit(self) -> np.ndarray:
        """[capacity]."""
        return self._table.array("opacity_logit")

    @property
    def colour(self) -> np.ndarray:
        """[capacity, 3] RGB."""
        return self._table.array("colour")

    @property
    def embedding(self) -> np.ndarray:
        """[capacity, 3] theta of Eq. 1."""
        return self._table.array("embedding")

    @property
    def plane_id(self) -> np.ndarray:
        """[capacity] int32, -1 = on none."""
        return self._table.array("plane_id")

    def array(self, name: str) -> np.ndarray:
        """A column with its spare rows, where it lives."""
        return self._table.array(name)

    def host(self, name: str) -> np.ndarray:
        """The rows in use of a column on the host, to be read: a view on the CPU, a copy under CUDA."""
        return self._table.host(name)

    def write(self, name: str, rows: slice | NDArray[np.integer] | NDArray[np.bool_], values: np.ndarray) -> None:
        """Set rows of a column from host values."""
        self._table.write(name, rows, values)

    def add_columns(self, columns: Iterable[Column]) -> None:
        """Columns for somebody's own bookkeeping, zero in all rows and in those that come."""
        for column in columns:
            self._table.add_column(column)

    def append(self, gaussians: Gaussians, **known: np.ndarray) -> None:
        """Add rows at the end. known: values of other columns; the rest is zero.

        Without carriers, a Gaussian follows the keyframe that it was born with.
        """
        values = {name: getattr(gaussians, name) for name in _FIELDS} | known
        values.setdefault("carriers", np.repeat(gaussians.birth_keyframe[:, None], CARRIERS, 1))
        self._table.append(len(gaussians), values)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the rows where `mask` [count] is false; the order of the rest stays."""
        if not mask.all():
            self._table.keep(mask)

    def move(self, motions: NDArray[np.float64]) -> None:
        """Move each row by the mean of its carriers' motions, p_w <- motion p_w: rigid, [K, 4, 4] by keyframe."""
        rigid.move_rows(motions, self.array("carriers"), self.mean, self.quat_wxyz, self.count)

    def gaussians(self) -> Gaussians:
        """A copy on the host."""
        return self.rows(np.arange(self.count))

    def rows(self, numbers: NDArray[np.integer]) -> Gaussians:
        """A copy of some rows on the host."""
        return Gaussians(**{name: self.host(name)[numbers] for name in _FIELDS})
