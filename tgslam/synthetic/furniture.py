"""Materials, walls and furniture that the scenes are put together from. World frame: z up, metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tgslam.kernels.procedural import BOOKS, CLOUD, PICTURE, PLAIN, PLANKS, TILES, WEAVE
from tgslam.synthetic.scene import Material, Rgb, SceneBuilder, Vector, yaw_rotation

UP = (0.0, 0.0, 1.0)

WHITE_WALL = Material(PLAIN, (0.84, 0.83, 0.79), scale_s_m=1.7, scale_t_m=1.3, contrast=0.015, seed=3, edge_shade=0.22)
CEILING = replace(WHITE_WALL, colour=(0.9, 0.9, 0.88), seed=4)
PLASTER = Material(CLOUD, (0.80, 0.72, 0.58), (0.60, 0.49, 0.38), 0.22, 0.22, 0.75, 11, 0.22)
WALLPAPER = Material(WEAVE, (0.63, 0.70, 0.66), (0.44, 0.53, 0.52), 0.16, 0.24, 0.55, 12, 0.22)
BRICK = Material(PLANKS, (0.70, 0.42, 0.32), (0.50, 0.28, 0.22), 0.26, 0.085, 0.9, 13, 0.22)
FLOORBOARDS = Material(PLANKS, (0.66, 0.50, 0.34), (0.46, 0.32, 0.20), 1.1, 0.13, 0.9, 14, 0.2)
FLOOR_TILES = Material(TILES, (0.66, 0.65, 0.60), (0.45, 0.44, 0.42), 0.4, 0.4, 0.3, 15, 0.2)
LINOLEUM = Material(CLOUD, (0.52, 0.54, 0.52), (0.42, 0.44, 0.43), 0.5, 0.5, 0.35, 16, 0.2)
RUG = Material(WEAVE, (0.62, 0.28, 0.24), (0.25, 0.20, 0.33), 0.17, 0.23, 0.7, 17)
OAK = Material(PLANKS, (0.70, 0.52, 0.33), (0.54, 0.37, 0.22), 0.9, 0.12, 0.7, 18)
DARK_WOOD = Material(PLANKS, (0.40, 0.26, 0.17), (0.28, 0.18, 0.12), 0.8, 0.1, 0.7, 19)
WHITE_LACQUER = Material(PLAIN, (0.82, 0.82, 0.80), scale_s_m=0.6, scale_t_m=0.6, contrast=0.03, seed=20)
METAL = Material(PLAIN, (0.50, 0.52, 0.54), scale_s_m=0.1, scale_t_m=0.3, contrast=0.12, seed=21)
SOFA_CLOTH = Material(WEAVE, (0.26, 0.38, 0.50), (0.18, 0.27, 0.38), 0.07, 0.07, 0.6, 22)
CUSHION = Material(WEAVE, (0.85, 0.66, 0.25), (0.62, 0.36, 0.16), 0.06, 0.09, 0.8, 23)
CARDBOARD = Material(CLOUD, (0.70, 0.55, 0.38), (0.58, 0.44, 0.29), 0.12, 0.05, 0.6, 24)
CLAY = Material(CLOUD, (0.72, 0.40, 0.27), (0.56, 0.29, 0.19), 0.09, 0.05, 0.7, 25)
LEAVES = Material(CLOUD, (0.40, 0.58, 0.24), (0.13, 0.30, 0.11), 0.05, 0.05, 1.2, 26)
BALL = Material(TILES, (0.80, 0.34, 0.20), (0.95, 0.93, 0.85), 0.1, 0.1, 0.5, 27)
PORCELAIN = Material(PLAIN, (0.86, 0.87, 0.90), scale_s_m=0.05, scale_t_m=0.05, contrast=0.05, seed=28)
BOOK_ROW = Material(BOOKS, (0.75, 0.40, 0.30), (0.22, 0.34, 0.45), 0.042, 1.0, 0.0, 29)
SCREEN = Material(PICTURE, (0.30, 0.36, 0.45), (0.06, 0.06, 0.07), 0.07, 0.07, 0.5, 30)
DOOR_LEAF = Material(CLOUD, (0.58, 0.43, 0.30), (0.47, 0.34, 0.23), 0.05, 0.9, 0.6, 31)
DOOR_PANEL = Material(CLOUD, (0.49, 0.35, 0.24), (0.39, 0.28, 0.18), 0.05, 0.7, 0.6, 32)
WHITE_PANEL = replace(WHITE_LACQUER, colour=(0.77, 0.77, 0.75), seed=33)


def picture(colour: Rgb, seed: int, grain_m: float = 0.11) -> Material:
    """An abstract picture of that mean colour in a white mount."""
    return Material(PICTURE, colour, (0.93, 0.92, 0.88), grain_m, grain_m, 0.5, seed)


def raised(point_w: Vector, height_m: float) -> Vector:
    """The point [3] that much higher."""
    return point_w + np.array([0.0, 0.0, height_m])


@dataclass(frozen=True)
class Wall:
    """A wall as a surface to hang things on."""

    label: int
    foot_w: Vector  # [3] m, the middle of its lower edge
    along_w: Vector  # [3] unit, to the right of somebody who looks at it

    def at(self, s_m: float, height_m: float, out_m: float = 0.0) -> Vector:
        """The world point s_m right of the wall's middle, at that height, out_m in front of it."""
        return raised(self.foot_w + s_m * self.along_w + out_m * np.cross(self.along_w, UP), height_m)


def wall(
    builder: SceneBuilder, start: tuple[float, float], end: tuple[float, float], height_m: float, material: Material
) -> Wall:
    """A wall from floor point `start` to `end`, as seen left to right from the room it faces."""
    a, b = np.array([*start, 0.0]), np.array([*end, 0.0])
    length = float(np.linalg.norm(b - a))
    along, foot = (b - a) / length, (a + b) / 2
    label = builder.quad(raised(foot, height_m / 2), along, UP, (length, height_m), material)
    return Wall(label, foot, along)


def hang(
    builder: SceneBuilder,
    on: Wall,
    s_m: float,
    height_m: float,
    size: tuple[float, float],
    material: Material,
    layer: int = 1,
) -> None:
    """Paint a rectangle of `size` (width, height) m on a wall, exactly coplanar with it."""
    builder.quad(on.at(s_m, height_m), on.along_w, UP, size, material, painted_on=on.label, layer=layer)


def floor_and_ceiling(
    builder: SceneBuilder, low: tuple[float, float], high: tuple[float, float], height_m: float, floor: Material
) -> int:
    """Floor and ceiling over the rectangle from `low` to `high` (x, y) m. Returns the floor's plane label."""
    x, y = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
    size = (high[0] - low[0], high[1] - low[1])
    builder.quad((x, y, height_m), (1, 0, 0), (0, -1, 0), size, CEILING)
    return builder.quad((x, y, 0), (1, 0, 0), (0, 1, 0), size, floor)


def room_shell(
    builder: SceneBuilder,
    size: tuple[float, float, float],
    floor: Material,
    walls: tuple[Material, Material, Material, Material],
) -> tuple[tuple[Wall, Wall, Wall, Wall], int]:
    """A closed room centred on the origin: its walls (north is +y, east, south, west) and the floor's label."""
    x, y, height = size[0] / 2, size[1] / 2, size[2]
    label = floor_and_ceiling(builder, (-x, -y), (x, y), height, floor)
    corners = ((-x, y), (x, y), (x, -y), (-x, -y), (-x, y))
    built = [wall(builder, corners[i], corners[i + 1], height, walls[i]) for i in range(4)]
    return (built[0], built[1], built[2], built[3]), label


def skirting(builder: SceneBuilder, on: Wall, length_m: float, material: Material = WHITE_LACQUER) -> None:
    """A skirting board along the middle `length_m` of a wall."""
    box_at(builder, on, 0.0, 0.04, (length_m, 0.015, 0.08), material)


def box_at(
    builder: SceneBuilder, on: Wall, s_m: float, height_m: float, size: tuple[float, float, float], material: Material
) -> int:
    """A box (width along the wall, depth out of it, height) with its back on the wall, centred at (s_m, height_m)."""
    yaw = float(np.arctan2(on.along_w[1], on.along_w[0]))
    return builder.box(on.at(s_m, height_m, size[1] / 2), size, material, yaw)


def door(builder: SceneBuilder, on: Wall, s_m: float, leaf: Material = DOOR_LEAF, panel: Material = DOOR_PANEL) -> None:
    """A door of 0.9 by 2.05 m with frame, panels and a round knob."""
    hang(builder, on, s_m, 1.025, (0.9, 2.05), leaf)
    for height, tall in ((0.55, 0.7), (1.45, 0.75)):
        for side in (-0.2, 0.2):
            hang(builder, on, s_m + side, height, (0.26, tall), panel, 2)
    for side in (-0.49, 0.49):
        box_at(builder, on, s_m + side, 1.05, (0.08, 0.04, 2.1), WHITE_LACQUER)
    box_at(builder, on, s_m, 2.09, (0.9, 0.04, 0.08), WHITE_LACQUER)
    builder.ellipsoid(on.at(s_m + 0.38, 1.02, 0.05), (0.03, 0.03, 0.03), METAL)


def table(
    builder: SceneBuilder,
    centre: tuple[float, float],
    size: tuple[float, float],
    height_m: float,
    material: Material,
    yaw_rad: float = 0.0,
    round_legs: bool = False,
) -> int:
    """A table of top `size` (x, y) m before turning by yaw. Returns the label of its top."""
    R, middle = yaw_rotation(yaw_rad), np.array([*centre, 0.0])
    first = builder.box(raised(middle, height_m - 0.02), (*size, 0.04), material, yaw_rad)
    leg_m = height_m - 0.04
    for x in (-1, 1):
        for y in (-1, 1):
            foot = middle + R @ np.array([x * (size[0] / 2 - 0.06), y * (size[1] / 2 - 0.06), 0.0])
            if round_legs:
                builder.cylinder(foot, 0.025, leg_m, METAL)
            else:
                builder.box(raised(foot, leg_m / 2), (0.06, 0.06, leg_m), material, yaw_rad)
    return first + 5


def chair(builder: SceneBuilder, centre: tuple[float, float], yaw_rad: float, material: Material = DARK_WOOD) -> None:
    """A chair whose back is on its local -y side."""
    table(builder, centre, (0.42, 0.42), 0.46, material, yaw_rad)
    back = np.array([*centre, 0.70]) + yaw_rotation(yaw_rad) @ np.array([0.0, -0.19, 0.0])
    builder.box(back, (0.42, 0.03, 0.48), material, yaw_rad)


def sofa(
    builder: SceneBuilder,
    centre: tuple[float, float],
    yaw_rad: float,
    length_m: float = 1.9,
    cloth: Material = SOFA_CLOTH,
) -> None:
    """A sofa whose back is on its local -y side, with two round cushions."""
    R, middle = yaw_rotation(yaw_rad), np.array([*centre, 0.0])

    def part(x: float, y: float, z: float, size: tuple[float, float, float]) -> None:
        builder.box(middle + R @ np.array([x, y, z]), size, cloth, yaw_rad)

    part(0, 0.05, 0.22, (length_m - 0.36, 0.8, 0.44))
    part(0, -0.36, 0.42, (length_m - 0.36, 0.2, 0.84))
    for side in (-1, 1):
        part(side * (length_m / 2 - 0.09), 0.0, 0.31, (0.18, 0.92, 0.62))
        at = middle + R @ np.array([side * (length_m / 2 - 0.42), -0.16, 0.60])
        builder.ellipsoid(at, (0.22, 0.09, 0.19), CUSHION, yaw_rad + 0.2 * side)


def shelf(builder: SceneBuilder, on: Wall, s_m: float, width_m: float = 1.2, boards: int = 5) -> None:
    """A bookcase against a wall: boards, sides, books and a few round things."""
    depth_m, step_m = 0.3, 0.36
    tall = step_m * (boards - 1) + 0.03
    for side in (-1, 1):
        box_at(builder, on, s_m + side * (width_m / 2 + 0.0125), tall / 2, (0.025, depth_m, tall), OAK)
    for board in range(boards):
        low = board * step_m
        box_at(builder, on, s_m, low + 0.015, (width_m, depth_m, 0.03), OAK)
        if board == boards - 1:
            break
        share = (0.62, 0.8, 0.5, 0.7)[board % 4]
        side = 1 if board % 2 else -1
        books = replace(BOOK_ROW, seed=BOOK_ROW.seed + 50 * board)
        middle = s_m - side * width_m * (1 - share) / 2
        box_at(builder, on, middle, low + 0.03 + 0.14, (width_m * share, 0.22, 0.28), books)
        free = s_m + side * width_m * share / 2
        if board % 2:
            builder.ellipsoid(on.at(free, low + 0.12, 0.15), (0.09, 0.09, 0.09), BALL)
        else:
            builder.cylinder(on.at(free, low + 0.03, 0.15), 0.06, 0.2, CLAY)


def plant(builder: SceneBuilder, x: float, y: float, height_m: float = 1.2) -> None:
    """A pot with a stem and a crown of leaves: nothing of it but the rims is plane."""
    builder.cylinder((x, y, 0.0), 0.17, 0.3, CLAY)
    builder.cylinder((x, y, 0.3), 0.02, height_m - 0.6, DARK_WOOD)
    blobs = (
        (0, 0, 0, 0.24),
        (0.15, 0.08, -0.14, 0.17),
        (-0.14, 0.1, -0.08, 0.18),
        (0.02, -0.16, -0.1, 0.17),
        (0, 0.05, 0.2, 0.15),
    )
    for i, (dx, dy, dz, radius) in enumerate(blobs):
        builder.ellipsoid(
            (x + dx, y + dy, height_m - 0.2 + dz), (radius, radius, 0.8 * radius), replace(LEAVES, seed=26 + i)
        )


def floor_lamp(builder: SceneBuilder, x: float, y: float) -> None:
    """A standing lamp with a round shade."""
    builder.cylinder((x, y, 0.0), 0.15, 0.03, METAL)
    builder.cylinder((x, y, 0.03), 0.015, 1.4, METAL)
    builder.cylinder((x, y, 1.38), 0.2, 0.3, replace(CUSHION, colour=(0.93, 0.88, 0.74), second=(0.84, 0.76, 0.6)))


def mug(builder: SceneBuilder, x: float, y: float, z: float) -> None:
    """A mug standing at height z m."""
    builder.cylinder((x, y, z), 0.04, 0.1, PORCELAIN)


def monitor(builder: SceneBuilder, x: float, y: float, z: float, yaw_rad: float, seed: int) -> None:
    """A screen on a foot that stands at height z m and faces its local -y side."""
    R, foot = yaw_rotation(yaw_rad), np.array([x, y, z])
    builder.box(raised(foot, 0.01), (0.24, 0.18, 0.02), METAL, yaw_rad)
    builder.cylinder(raised(foot, 0.02), 0.025, 0.16, METAL)
    first = builder.box(raised(foot, 0.36), (0.6, 0.04, 0.36), replace(METAL, colour=(0.1, 0.1, 0.11)), yaw_rad)
    face = raised(foot, 0.36) + R @ np.array([0.0, -0.02, 0.0])
    builder.quad(face, R[:, 0], UP, (0.56, 0.32), replace(SCREEN, seed=seed), painted_on=first + 2)


def clutter(
    builder: SceneBuilder,
    centre: tuple[float, float],
    height_m: float,
    seed: int,
    reach: tuple[float, float] = (0.28, 0.24),
) -> None:
    """A box, a ball, a mug, a bowl and a book on an oval of radii `reach` m round `centre`, standing at height_m."""
    rng = np.random.default_rng(seed)

    def spot(angle: float) -> tuple[float, float]:
        far = rng.uniform(0.8, 1.1)
        return float(centre[0] + far * reach[0] * np.cos(angle)), float(centre[1] + far * reach[1] * np.sin(angle))

    turn = rng.uniform(0, 2 * np.pi)
    x, y = spot(turn)
    builder.box((x, y, height_m + 0.09), (0.2, 0.14, 0.18), CARDBOARD, turn)
    x, y = spot(turn + 1.3)
    builder.ellipsoid((x, y, height_m + 0.07), (0.07, 0.07, 0.07), BALL, turn)
    mug(builder, *spot(turn + 2.5), height_m)
    x, y = spot(turn + 3.7)
    builder.ellipsoid((x, y, height_m + 0.05), (0.13, 0.13, 0.05), CLAY)
    x, y = spot(turn + 5.0)
    builder.box((x, y, height_m + 0.015), (0.15, 0.21, 0.03), picture((0.45, 0.3, 0.3), seed, 0.05), turn + 0.4)
