"""The kitchen: x along the back wall, y up, z from the back wall to the camera, metres.

Things do not share planes with what they stand on: `LIFT` is between.
"""

from __future__ import annotations

import numpy as np
from whole_xml import (
    Triple,
    area,
    bitmap,
    box,
    bsdf,
    diffuse,
    element,
    glossy,
    material,
    ply,
    ref,
    rgb,
    sphere,
    triple,
    value,
)

LIFT = 0.001  # between a thing and what it stands on
WIDTH, DEPTH, HEIGHT = 3.2, 2.7, 2.7
TOP = 0.9  # of the counter
FRONT = 0.56  # of the cabinets
COLUMN = 0.4  # width of a cabinet
SHELVES = (1.475, 1.825)  # their upper sides
TILE = (0.2, 0.25)


def looks() -> list[str]:
    """All BSDFs."""
    planks = bitmap("diffuse_reflectance", "textures/wood.png", (3, 2.5))
    board = bitmap("diffuse_reflectance", "textures/wood.png", (1, 0.5))
    return [
        diffuse("plaster", 0.75, 0.71, 0.63),
        bsdf("roughplastic", "floor_wood", planks, value("alpha", 0.15)),
        bsdf("roughplastic", "board_wood", board, value("alpha", 0.25)),
        glossy("roughplastic", "cabinet", 0.16, 0.3, 0.32, alpha=0.2),
        glossy("roughplastic", "front", 0.22, 0.4, 0.42, alpha=0.2),
        glossy("roughplastic", "stone", 0.6, 0.58, 0.54, alpha=0.12),
        glossy("plastic", "tile_white", 0.72, 0.73, 0.7),
        glossy("plastic", "tile_cream", 0.68, 0.6, 0.45),
        glossy("plastic", "tile_blue", 0.2, 0.36, 0.5),
        glossy("plastic", "black", 0.02, 0.02, 0.022),
        glossy("plastic", "porcelain", 0.8, 0.79, 0.75),
        glossy("plastic", "red_glaze", 0.6, 0.09, 0.06),
        glossy("plastic", "blue_glaze", 0.1, 0.2, 0.5),
        glossy("plastic", "yellow_glaze", 0.75, 0.52, 0.1),
        glossy("plastic", "lemon", 0.8, 0.65, 0.06),
        glossy("plastic", "apple", 0.45, 0.5, 0.08),
        bsdf("roughconductor", "brass", material("Cu"), value("alpha", 0.2)),
        bsdf("roughconductor", "steel", material("Al"), value("alpha", 0.25)),
        bsdf("conductor", "chrome", material("Cr")),
        bsdf("dielectric", "glass", value("int_ior", 1.5)),
        bsdf("thindielectric", "green_glass", rgb("specular_transmittance", 0.55, 0.85, 0.6)),
    ]


def room() -> list[str]:
    """Two walls and the floor, each as thick as a hand is wide."""
    return [
        box("floor", (-0.1, -0.1, -0.1), (WIDTH, 0, DEPTH), "floor_wood"),
        box("wall_back", (0, LIFT, -0.1), (WIDTH, HEIGHT, 0), "plaster"),
        box("wall_left", (-0.1, LIFT, -0.1), (-LIFT, HEIGHT, DEPTH), "plaster"),
    ]


def counter() -> list[str]:
    """Cabinets with doors, drawers and an oven; their top, a hob, and tiles."""
    parts = [
        box("plinth", (LIFT, LIFT, LIFT), (WIDTH, 0.1, FRONT - 0.06), "black"),
        box("carcass", (LIFT, 0.1 + LIFT, LIFT), (WIDTH, 0.86, FRONT), "cabinet"),
        box("worktop", (LIFT, 0.86 + LIFT, LIFT), (WIDTH, TOP, FRONT + 0.06), "stone"),
        box(
            "oven",
            (5 * COLUMN + 0.01, 0.12, FRONT + LIFT),
            (7 * COLUMN - 0.01, 0.845, FRONT + 0.022),
            "black",
        ),
        box("oven_bar", (2.1, 0.755, FRONT + 0.04), (2.7, 0.775, FRONT + 0.06), "steel"),
        box("oven_bar_left", (2.13, 0.758, FRONT + 0.015), (2.15, 0.772, FRONT + 0.041), "steel"),
        box("oven_bar_right", (2.65, 0.758, FRONT + 0.015), (2.67, 0.772, FRONT + 0.041), "steel"),
        box("hob", (2.05, TOP + LIFT, 0.06), (2.75, TOP + 0.008, 0.56), "black"),
    ]
    for k, (x, z) in enumerate([(2.22, 0.18), (2.58, 0.18), (2.22, 0.42), (2.58, 0.42)]):
        parts.append(ply(f"burner_{k}", "disc", "steel", (x, TOP + 0.008 + LIFT, z)))
    for column in (0, 1, 7):
        knob_x = (column + (0.15 if column == 1 else 0.85)) * COLUMN
        parts += front(f"door_{column}", column, (0.12, 0.845), (knob_x, 0.76))
    for column in (2, 3, 4):
        for k, (low, high) in enumerate([(0.12, 0.39), (0.396, 0.666), (0.672, 0.845)]):
            parts += front(f"drawer_{column}{k}", column, (low, high), ((column + 0.5) * COLUMN, high - 0.07))
    return parts


def front(name: str, column: int, heights: tuple[float, float], knob: tuple[float, float]) -> list[str]:
    """A door or drawer of the counter with its knob at (x, y)."""
    low, high = (column * COLUMN + 0.003, heights[0]), ((column + 1) * COLUMN - 0.003, heights[1])
    return [
        box(name, (*low, FRONT + LIFT), (*high, FRONT + 0.02), "front"),
        upright_knob(f"{name}_knob", (*knob, FRONT + 0.02)),
    ]


def upright_knob(name: str, at: Triple) -> str:
    """A knob whose axis is z."""
    lines = [f'<rotate x="1" angle="90"/>\n<translate x="{at[0]:g}" y="{at[1]:g}" z="{at[2] - 0.002:g}"/>']
    return element(
        "shape",
        f'type="ply" id="{name}"',
        '<string name="filename" value="meshes/knob.ply"/>',
        element("transform", 'name="to_world"', *lines),
        ref("brass"),
    )


def tiles() -> list[str]:
    """Two courses behind the counter."""
    rng = np.random.default_rng(3)
    names = rng.choice(["white", "cream", "blue"], (2, 16), p=[0.6, 0.25, 0.15])
    parts = []
    for row in range(2):
        for k in range(16):
            low = (k * TILE[0] + 0.003, TOP + 0.004 + row * TILE[1], LIFT)
            high = ((k + 1) * TILE[0] - 0.003, TOP - 0.002 + (row + 1) * TILE[1], 0.01)
            parts.append(box(f"tile_{row}_{k}", low, high, f"tile_{names[row, k]}"))
    return parts


def cupboard() -> list[str]:
    """A cabinet on the wall with two doors, and the hood above the hob."""
    parts = [box("cupboard", (LIFT, 1.45, LIFT), (0.8, 2.15, 0.33), "cabinet")]
    for k in range(2):
        parts.append(
            box(
                f"cupboard_door_{k}", (0.003 + 0.4 * k, 1.453, 0.331), (0.397 + 0.4 * k, 2.147, 0.35), "front"
            )
        )
        parts.append(upright_knob(f"cupboard_knob_{k}", (0.34 + 0.12 * k, 1.52, 0.35)))
    parts.append(box("hood", (2.05, 1.6, LIFT), (2.75, 1.72, 0.48), "steel"))
    parts.append(box("hood_chimney", (2.25, 1.72 + LIFT, LIFT), (2.55, HEIGHT, 0.3), "steel"))
    return parts


def shelves() -> list[str]:
    """Two boards on brackets, and the crockery on them."""
    parts = []
    for k, top in enumerate(SHELVES):
        parts.append(box(f"shelf_{k}", (0.9, top - 0.025, LIFT), (1.9, top, 0.26), "board_wood"))
        for side, x in (("left", 0.98), ("right", 1.8)):
            parts.append(
                box(
                    f"bracket_{k}_{side}", (x, top - 0.09, LIFT), (x + 0.02, top - 0.025 - LIFT, 0.2), "brass"
                )
            )
    low, high = (top + LIFT for top in SHELVES)
    glazes = ["porcelain", "red_glaze", "blue_glaze", "yellow_glaze"]
    for k in range(4):
        parts.append(
            ply(f"mug_{k}", "mug", glazes[k], (1.0 + 0.13 * k, low, 0.12 + 0.02 * (k % 2)), -50 + 25 * k)
        )
    for k in range(2):
        parts.append(ply(f"glass_{k}", "glass", "glass", (1.5 + 0.09 * k, low, 0.16 - 0.03 * k)))
    for k in range(6):
        parts.append(ply(f"plate_{k}", "plate", "porcelain", (1.755, low + 0.008 * k, 0.135)))
    for k in range(3):
        look = ("porcelain", "blue_glaze", "porcelain")[k]
        parts.append(ply(f"bowl_{k}", "bowl", look, (1.0, high + 0.024 * k, 0.13)))
    for k in range(2):
        parts.append(ply(f"bowl_{3 + k}", "bowl", glazes[1 + 2 * k], (1.19 + 0.18 * k, high, 0.13)))
    parts.append(ply("vase", "vase", "red_glaze", (1.57, high, 0.13)))
    parts.append(ply("bottle_shelf", "bottle", "green_glass", (1.75, high, 0.12)))
    parts.append(ply("mug_4", "mug", "blue_glaze", (1.84, high, 0.16), -60))
    return parts


def still_life() -> list[str]:
    """What stands on the counter and the hob."""
    up = TOP + LIFT
    parts = [
        box("board", (0.42, up, 0.16), (0.82, TOP + 0.022, 0.44), "board_wood"),
        ply("bottle", "bottle", "green_glass", (0.27, up, 0.24)),
        ply("fruit_bowl", "fruit_bowl", "porcelain", (1.16, up, 0.32)),
        ply("glass_2", "glass", "glass", (1.5, up, 0.36)),
        ply("glass_3", "glass", "glass", (1.62, up, 0.27)),
        ply("mug_5", "mug", "yellow_glaze", (1.81, up, 0.4), -35),
        ply("pot", "pot", "chrome", (2.22, TOP + 0.018 + 2 * LIFT, 0.42)),
        ply("lid", "lid", "chrome", (2.22, TOP + 0.018 + 0.141 + 3 * LIFT, 0.42)),
        ply("lamp_stand", "stand", "brass", (2.98, up, 0.26)),
    ]
    lemons = [(0.53, 0.27), (0.61, 0.33), (0.62, 0.24)]
    parts += [sphere(f"lemon_{k}", (x, 0.957, z), 0.034, ref("lemon")) for k, (x, z) in enumerate(lemons)]
    apples = [(1.11, 0.977, 0.29), (1.21, 0.977, 0.29), (1.16, 0.977, 0.375), (1.16, 1.045, 0.318)]
    looks_of = ("apple", "red_glaze", "apple", "red_glaze")
    parts += [
        sphere(f"apple_{k}", at, 0.043, ref(look))
        for k, (at, look) in enumerate(zip(apples, looks_of, strict=True))
    ]
    return parts


def stool() -> list[str]:
    """A seat on four legs, before the left wall."""
    x, z, height = 0.62, 1.35, 0.48
    parts = [ply("seat", "seat", "board_wood_plain", (x, height + LIFT, z))]
    for k, (dx, dz) in enumerate([(-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1), (0.1, 0.1)]):
        low, high = (x + dx - 0.015, LIFT, z + dz - 0.015), (x + dx + 0.015, height, z + dz + 0.015)
        parts.append(box(f"leg_{k}", low, high, "board_wood_plain"))
    return parts


def lamps() -> list[str]:
    """A globe on a stand, and a spot under the hood."""
    aim = f'<lookat origin="{triple((2.4, 1.595, 0.36))}" target="{triple((2.33, 0.9, 0.34))}" up="0, 0, 1"/>'
    return [
        sphere("globe", (2.98, TOP + 0.337 + 0.085, 0.26), 0.085, area(14, 11, 7)),
        element(
            "emitter",
            'type="spot" id="hood_spot"',
            element("transform", 'name="to_world"', aim),
            rgb("intensity", 3, 2.7, 2.2),
            value("cutoff_angle", 42),
            value("beam_width", 28),
        ),
    ]


def kitchen() -> list[str]:
    """All parts."""
    plain = glossy("roughplastic", "board_wood_plain", 0.42, 0.25, 0.12, alpha=0.25)
    return [
        *looks(),
        plain,
        *room(),
        *counter(),
        *tiles(),
        *cupboard(),
        *shelves(),
        *still_life(),
        *stool(),
        *lamps(),
    ]
