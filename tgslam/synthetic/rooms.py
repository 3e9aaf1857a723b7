"""The single-room scenes: geometry only. Every room is centred on the origin of the world's floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tgslam.synthetic import furniture as f
from tgslam.synthetic.scene import Lighting, Scene, SceneBuilder


def living_room() -> Scene:
    """5 x 4.2 m: three textured walls and a blank one (south), table, sofa, bookcase, boxes and round clutter."""
    builder = SceneBuilder(Lighting(lamp_position_w=(0.3, 0.2, 2.3)))
    materials = (f.WALLPAPER, f.BRICK, f.WHITE_WALL, f.PLASTER)
    (north, east, south, west), floor = f.room_shell(builder, (5.0, 4.2, 2.6), f.FLOORBOARDS, materials)
    for side, length in ((north, 4.97), (south, 4.97), (west, 4.17)):
        f.skirting(builder, side, length)
    builder.quad((0.2, 0.1, 0), (1, 0, 0), (0, 1, 0), (2.2, 1.6), f.RUG, painted_on=floor)
    f.shelf(builder, north, -1.2)
    f.hang(builder, north, 0.5, 1.6, (0.9, 0.6), f.picture((0.45, 0.5, 0.6), 61))
    f.hang(builder, north, 1.5, 1.5, (0.5, 0.7), f.picture((0.6, 0.45, 0.35), 62, 0.08))
    f.box_at(builder, east, 0.9, 1.6, (0.7, 0.03, 0.5), f.picture((0.5, 0.55, 0.4), 63))
    f.door(builder, south, 1.3)
    f.hang(builder, west, -1.2, 1.65, (0.6, 0.8), f.picture((0.55, 0.4, 0.5), 64))
    f.hang(builder, west, 0.6, 1.7, (1.1, 0.55), f.picture((0.35, 0.5, 0.45), 65, 0.15))
    f.sofa(builder, (-1.9, 0.1), -np.pi / 2)
    f.table(builder, (1.55, 0.75), (1.3, 0.8), 0.74, f.OAK, 0.12)
    f.clutter(builder, (1.55, 0.75), 0.74, 5)
    f.chair(builder, (1.45, 1.5), np.pi)
    f.chair(builder, (1.2, 0.05), 0.25)
    builder.box((2.1, -1.6, 0.25), (0.6, 0.6, 0.5), f.CARDBOARD, 0.3)
    builder.box((2.15, -1.6, 0.65), (0.4, 0.35, 0.3), replace(f.CARDBOARD, seed=71), -0.2)
    builder.box((1.5, -1.75, 0.15), (0.4, 0.4, 0.3), replace(f.CARDBOARD, seed=72), 0.6)
    builder.ellipsoid((0.75, -1.75, 0.16), (0.16, 0.16, 0.16), f.BALL)
    f.plant(builder, 2.1, 1.75, 1.35)
    f.floor_lamp(builder, -2.15, -1.7)
    return builder.build()


def loop_room() -> Scene:
    """6.4 x 5.2 m with a table island in the middle and furniture all round."""
    builder = SceneBuilder(Lighting(lamp_position_w=(0.0, 0.0, 2.5)))
    materials = (f.PLASTER, f.WALLPAPER, f.BRICK, f.WHITE_WALL)
    (north, east, south, west), _ = f.room_shell(builder, (6.4, 5.2, 2.7), f.FLOOR_TILES, materials)
    for side, length in ((north, 6.37), (east, 5.17), (west, 5.17)):
        f.skirting(builder, side, length)
    f.table(builder, (0.0, 0.0), (0.9, 0.6), 0.72, f.DARK_WOOD, 0.2)
    f.clutter(builder, (0.0, 0.0), 0.72, 8)
    f.shelf(builder, north, 1.6, 1.4)
    f.hang(builder, north, -0.4, 1.6, (1.2, 0.7), f.picture((0.4, 0.5, 0.55), 81, 0.14))
    f.sofa(builder, (-1.7, 2.05), np.pi)
    f.door(builder, east, -1.6)
    f.table(builder, (2.75, -0.9), (0.7, 1.4), 0.75, f.OAK)
    f.monitor(builder, 2.85, -0.9, 0.75, -np.pi / 2, 82)
    f.clutter(builder, (2.75, -1.3), 0.75, 9, (0.2, 0.22))
    f.chair(builder, (2.15, -0.7), np.pi / 2)
    f.box_at(builder, east, 1.5, 1.5, (0.8, 0.03, 0.6), f.picture((0.6, 0.5, 0.35), 83))
    f.hang(builder, south, 0.9, 1.6, (0.7, 0.9), f.picture((0.5, 0.42, 0.5), 84))
    f.plant(builder, 2.7, -2.15, 1.4)
    f.box_at(builder, south, -0.6, 0.4, (1.6, 0.45, 0.8), f.WHITE_LACQUER)
    f.clutter(builder, (0.6, -2.37), 0.8, 10, (0.6, 0.1))
    f.floor_lamp(builder, -2.8, -2.2)
    builder.box((-2.8, -1.1, 0.3), (0.5, 0.6, 0.6), f.CARDBOARD, 0.15)
    builder.ellipsoid((-2.75, -0.3, 0.2), (0.2, 0.2, 0.2), f.BALL)
    f.door(builder, west, 1.0)
    f.hang(builder, west, -0.8, 1.6, (0.5, 0.4), f.picture((0.45, 0.55, 0.4), 85, 0.07))
    return builder.build()


def blank_room() -> Scene:
    """4.6 x 4 m: white walls and a plain floor, little furniture and hardly any texture."""
    builder = SceneBuilder(Lighting(lamp_position_w=(-0.5, 0.4, 2.3)))
    floor_material = replace(f.WHITE_WALL, colour=(0.60, 0.58, 0.55), seed=91)
    (north, east, _, west), _ = f.room_shell(builder, (4.6, 4.0, 2.5), floor_material, (f.WHITE_WALL,) * 4)
    f.skirting(builder, north, 4.57)
    f.skirting(builder, east, 3.97)
    f.hang(builder, west, 0.5, 1.5, (0.4, 0.5), f.picture((0.5, 0.5, 0.5), 92))
    f.table(builder, (1.2, 1.0), (1.1, 0.7), 0.73, f.WHITE_LACQUER, -0.15, round_legs=True)
    f.mug(builder, 1.1, 0.95, 0.73)
    builder.ellipsoid((1.4, 1.1, 0.81), (0.08, 0.08, 0.08), f.PORCELAIN)
    f.sofa(builder, (-1.7, -0.2), -np.pi / 2, 1.7, replace(f.WHITE_LACQUER, colour=(0.55, 0.57, 0.6)))
    builder.box((1.8, -1.4, 0.45), (0.6, 0.5, 0.9), f.WHITE_LACQUER)
    builder.cylinder((0.2, -1.7, 0.0), 0.18, 0.45, f.PORCELAIN)
    f.door(builder, north, -1.2, f.WHITE_LACQUER, f.WHITE_PANEL)
    return builder.build()


def office() -> Scene:
    """5.4 x 4.6 m: two coplanar desk tops 0.35 m apart on one side of a 3 cm partition, a cabinet on the other side."""
    builder = SceneBuilder(Lighting(lamp_position_w=(0.0, 0.3, 2.4)))
    materials = (f.PLASTER, f.WHITE_WALL, f.WALLPAPER, f.PLASTER)
    (north, east, south, west), _ = f.room_shell(builder, (5.4, 4.6, 2.6), f.LINOLEUM, materials)
    f.skirting(builder, north, 5.37)
    builder.box((0.0, 0.0, 0.65), (2.3, 0.03, 1.3), replace(f.WALLPAPER, seed=101))
    for i, x in enumerate((-0.625, 0.625)):
        f.table(builder, (x, -0.4), (0.9, 0.7), 0.74, f.OAK, round_legs=True)
        f.monitor(builder, x, -0.22, 0.74, 0.0, 102 + i)
        f.mug(builder, x + 0.32, -0.5, 0.74)
        builder.box((x, -0.58, 0.75), (0.42, 0.14, 0.02), f.METAL)
        builder.ellipsoid((x - 0.34, -0.55, 0.78), (0.04, 0.04, 0.04), f.BALL)
    f.box_at(builder, north, 0.8, 0.5, (1.2, 0.4, 1.0), f.OAK)
    f.clutter(builder, (0.8, 2.1), 1.0, 11, (0.4, 0.08))
    builder.box((-0.5, 0.27, 0.35), (1.0, 0.5, 0.7), f.DARK_WOOD)
    f.clutter(builder, (-0.5, 0.27), 0.7, 12, (0.38, 0.12))
    builder.box((0.5, 0.25, 0.2), (0.4, 0.4, 0.4), f.CARDBOARD, 0.2)
    f.shelf(builder, west, 0.2)
    f.door(builder, south, -1.2)
    f.hang(builder, south, 0.8, 1.5, (1.0, 0.7), f.picture((0.5, 0.45, 0.4), 104))
    f.hang(builder, east, -0.6, 1.5, (0.9, 0.6), f.picture((0.4, 0.45, 0.55), 105))
    f.hang(builder, north, -1.2, 1.5, (0.8, 0.8), f.picture((0.55, 0.5, 0.35), 106))
    f.plant(builder, 2.3, 1.9, 1.3)
    return builder.build()
