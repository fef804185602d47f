"""Writes whole scenes of the kinds that people render, with their meshes and textures.

A Cornell box with a glass and a mirror ball, a kitchen, a tree of leaf cards with and without cut-outs, a wall of
instanced bricks, a room that is lit through its window.

``python scenes_xml/whole/make_whole.py`` from anywhere. It takes seconds and writes the same files again; a folder as
argument takes them instead.

Vertices by ``load_scene(path, edge_length)``, where backs that light can reach count: `cornell_glass` 44,600, `kitchen`
46,700 (edge_length=0.12), `tree` 63,200, `tree_plain` 79,200, `bricks` 59,400 (edge_length=1), `window` 57,700.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from whole_files import BRICKS, COURSE, PITCH, write_files
from whole_kitchen import kitchen
from whole_xml import (
    Triple,
    View,
    area,
    bitmap,
    box,
    bsdf,
    diffuse,
    element,
    glossy,
    material,
    number,
    ply,
    rectangle,
    ref,
    scene,
    shape,
    sphere,
    twosided,
    value,
)

FOLDER = Path(__file__).parent

COUNT = 1000  # bricks
STUDS = 66  # along the wall, which is two deep
COLOURS = {
    "red": (0.6, 0.05, 0.04),
    "yellow": (0.8, 0.55, 0.05),
    "blue": (0.05, 0.16, 0.5),
    "white": (0.75, 0.74, 0.7),
}


def cornell_glass() -> str:
    """A Cornell box, open towards the camera, with a lamp, a glass ball and a mirror ball."""
    view = View((0, 1, 4.1), (0, 1, 0), 50, "dawn", 90, 0.5, 8)
    down, up = '<rotate x="1" angle="90"/>', '<rotate x="1" angle="-90"/>'
    return scene(
        "A Cornell box with a glass ball and a mirror ball, its own lamp, and little light from outside.",
        view,
        twosided("white", 0.725, 0.71, 0.68),
        twosided("red", 0.63, 0.065, 0.05),
        twosided("green", 0.14, 0.45, 0.091),
        bsdf("dielectric", "glass", value("int_ior", 1.5)),
        bsdf("conductor", "mirror", material("none")),
        diffuse("black", 0, 0, 0),
        rectangle("floor", "white", up),
        rectangle("ceiling", "white", down, '<translate y="2"/>'),
        rectangle("back", "white", '<translate y="1" z="-1"/>'),
        rectangle("left", "red", '<rotate y="1" angle="90"/>', '<translate x="-1" y="1"/>'),
        rectangle("right", "green", '<rotate y="1" angle="-90"/>', '<translate x="1" y="1"/>'),
        sphere("glass_ball", (0.42, 0.352, 0.3), 0.35, ref("glass")),
        sphere("mirror_ball", (-0.42, 0.352, -0.3), 0.35, ref("mirror")),
        shape(
            "rectangle",
            "lamp",
            element("transform", 'name="to_world"', '<scale value="0.3"/>', down, '<translate y="1.99"/>'),
            ref("black"),
            area(8, 7, 5.6),
        ),
    )


def kitchen_corner() -> str:
    """The kitchen with its camera."""
    view = View((2.3, 1.66, 3.3), (1.68, 1.04, 0), 61, "city", 290, 0.8, 8)
    return scene(
        "The corner of a kitchen: plastics, metals, glass, two lamps. Use edge_length=0.12.", view, *kitchen()
    )


def tree(cut_out: bool) -> str:
    """A tree over uneven ground; its leaves are quads, or cut out of them."""
    green = twosided("" if cut_out else "leaf", 0.16, 0.33, 0.07)
    outline = bitmap("opacity", "textures/leaf.png", raw=True)
    return scene(
        f"A tree of 4000 leaf cards{', cut out by a bitmap of opacity' if cut_out else ' without cut-outs'}.",
        View((1.7, 1.3, 3.7), (0.05, 0.98, 0), 37, "city", 225, 1.2),
        bsdf("mask", "leaf", outline, green) if cut_out else green,
        diffuse("bark", 0.24, 0.17, 0.11),
        diffuse("grass", 0.24, 0.27, 0.11),
        ply("leaves", "leaves", "leaf"),
        ply("trunk", "trunk", "bark"),
        ply("clearing", "clearing", "grass"),
    )


def bricks() -> str:
    """A broken wall of toy bricks, and some that lie before it."""
    looks = [glossy("plastic", name, *rgb_of) for name, rgb_of in COLOURS.items()]
    groups = [
        element(
            "shape",
            f'type="shapegroup" id="{size}_{colour}"',
            ply(f"brick_{size}_{colour}", f"brick_{size}", colour),
        )
        for size in BRICKS
        for colour in COLOURS
    ]
    rng = np.random.default_rng(7)
    standing = wall(rng)
    placed = standing + loose(rng, COUNT - len(standing))
    colours = rng.choice(list(COLOURS), len(placed))
    copies = [
        instance(f"{size}_{colour}", at, turn)
        for (size, at, turn), colour in zip(placed, colours, strict=True)
    ]
    return scene(
        f"A wall of {COUNT} toy bricks of {len(groups)} kinds: groups and instances. Use edge_length=1.",
        View((3.0, 2.4, 7.6), (0.2, 0.95, 0.2), 49, "city", 225),
        *looks,
        diffuse("sand", 0.38, 0.34, 0.28),
        *groups,
        ply("yard", "yard", "sand", (0, -0.001, 0)),
        *copies,
    )


def wall(rng: np.random.Generator) -> list[tuple[str, Triple, float]]:
    """Bricks of a wall two studs deep, row by row from the left: kind, place and turn.

    What is below a brick is always full: the wall's outline falls in steps, and its front half is lower.
    """
    x = np.arange(STUDS)
    ruin = 15.4 + 5.5 * np.cos(0.085 * (x - 12)) + 2.2 * np.sin(0.45 * x) + rng.uniform(-1, 1, STUDS)
    outline = np.stack([ruin, 0.8 * ruin - 1], axis=-1).astype(int)  # [x, z] courses
    placed = []
    for course in range(outline.max()):
        empty = outline > course
        for left in range(STUDS):
            for back in range(2):
                if empty[left, back]:
                    fits = [s for s, (w, d) in BRICKS.items() if room_for(empty, (left, back), (w, d))]
                    weights = np.array(
                        [{"1x1": 2.5, "1x2": 4, "1x3": 0.6, "1x4": 0.3, "2x2": 0.4}[s] for s in fits]
                    )
                    size = str(rng.choice(fits, p=weights / weights.sum()))
                    width, depth = BRICKS[size]
                    empty[left : left + width, back : back + depth] = False
                    at = (left + width / 2 - STUDS / 2, course * COURSE, back + depth / 2 - 1)
                    placed.append((size, (at[0] * PITCH, at[1], at[2] * PITCH), 0.0))
    return placed


def room_for(empty: np.ndarray, corner: tuple[int, int], studs: tuple[int, int]) -> bool:
    """Whether a brick fits into what is empty [x, z] of a course."""
    block = empty[corner[0] : corner[0] + studs[0], corner[1] : corner[1] + studs[1]]
    return block.shape == studs and bool(block.all())


def loose(rng: np.random.Generator, count: int) -> list[tuple[str, Triple, float]]:
    """Bricks on the ground before the wall, at a distance from each other."""
    placed: list[tuple[str, Triple, float]] = []
    while len(placed) < count:
        x, z = rng.uniform(-2.9, 2.9), rng.uniform(0.4, 2.6)
        if all(np.hypot(x - at[0], z - at[2]) > 0.32 for _, at, _ in placed):
            placed.append((str(rng.choice(list(BRICKS))), (x, 0.0, z), float(rng.uniform(0, 360))))
    return placed


def instance(group: str, at: Triple, turn: float) -> str:
    """A copy of a group, in as few characters as can be."""
    x, y, z = map(number, at)
    turned = f'<rotate y="1" angle="{number(turn)}"/>' if turn else ""
    moved = f'<transform name="to_world">{turned}<translate x="{x}" y="{y}" z="{z}"/></transform>'
    return f'<shape type="instance">{ref(group)}{moved}</shape>'


def window() -> str:
    """A room that has light from its window alone."""
    return scene(
        "A room that is lit through a window with thin glass: a table, a chair, a curtain.",
        View((1.75, 1.5, 1.8), (-0.75, 0.98, -0.75), 62, "city", 170, 7),
        diffuse("wall", 0.78, 0.74, 0.66),
        diffuse("ceiling_white", 0.82, 0.82, 0.8),
        glossy("roughplastic", "boards", 0.4, 0.25, 0.14, alpha=0.2),
        diffuse("paint", 0.8, 0.8, 0.78),
        diffuse("oak", 0.45, 0.3, 0.17),
        diffuse("blue", 0.12, 0.2, 0.42),
        diffuse("ochre", 0.7, 0.45, 0.12),
        glossy("plastic", "glaze", 0.5, 0.1, 0.07),
        twosided("cloth", 0.55, 0.22, 0.2),
        bsdf("thindielectric", "pane"),
        *chamber(),
        *window_frame(),
        *furniture(),
    )


def chamber() -> list[str]:
    """Floor, ceiling and walls, from -2 to 2 and 2.6 high; all but the window's wall have one side, the inner one."""
    long, high = '<scale value="2"/>', '<scale x="2" y="1.3"/>'
    return [
        rectangle("floor", "boards", long, '<rotate x="1" angle="-90"/>'),
        rectangle("ceiling", "ceiling_white", long, '<rotate x="1" angle="90"/>', '<translate y="2.6"/>'),
        rectangle("wall_back", "wall", high, '<translate y="1.3" z="-2"/>'),
        rectangle("wall_front", "wall", high, '<rotate y="1" angle="180"/>', '<translate y="1.3" z="2"/>'),
        rectangle("wall_right", "wall", high, '<rotate y="1" angle="-90"/>', '<translate x="2" y="1.3"/>'),
        ply("wall_window", "window_wall", "wall", (-2, 0, 0)),
    ]


def window_frame() -> list[str]:
    """Frame, cross bars, sill and glass in the opening, which is 2.5 wide and 1.65 high; and the curtain beside it."""
    x0, x1 = -2.13, -2.07
    across = (
        '<scale x="1.25" y="0.825"/>',
        '<rotate y="1" angle="90"/>',
        '<translate x="-2.1" y="1.525" z="-0.15"/>',
    )
    frame = [
        box("frame_low", (x0, 0.701, -1.399), (x1, 0.76, 1.099), "paint"),
        box("frame_high", (x0, 2.29, -1.399), (x1, 2.349, 1.099), "paint"),
        box("frame_left", (x0, 0.761, 1.04), (x1, 2.289, 1.099), "paint"),
        box("frame_right", (x0, 0.761, -1.399), (x1, 2.289, -1.34), "paint"),
        box("bar_across", (-2.118, 1.72, -1.339), (-2.082, 1.755, 1.039), "paint"),
    ]
    for k, z in enumerate((-0.545, 0.245)):
        frame.append(box(f"bar_up_{k}", (-2.118, 0.761, z - 0.018), (-2.082, 2.289, z + 0.018), "paint"))
    for k, z in enumerate((-1.9, 1.6)):
        frame.append(box(f"rod_holder_{k}", (-1.999, 2.44, z - 0.015), (-1.77, 2.46, z + 0.015), "oak"))
    return [
        *frame,
        box("sill", (-2.06, 0.702, -1.398), (-1.88, 0.73, 1.098), "paint"),
        rectangle("glass", "pane", *across),
        ply("rod", "rod", "oak", (-1.78, 2.475, -0.15)),
        ply("curtain_left", "curtain", "cloth", (-1.78, 2.462, 1.15)),
        ply("curtain_right", "curtain", "cloth", (-1.78, 2.462, -1.45)),
    ]


def furniture() -> list[str]:
    """A table with a vase and books, a chair, two boxes."""
    table = [box("table_top", (-1.35, 0.71, -1.2), (-0.35, 0.75, 0.4), "oak")]
    for k, (x, z) in enumerate([(-1.3, -1.15), (-0.45, -1.15), (-1.3, 0.3), (-0.45, 0.3)]):
        table.append(box(f"table_leg_{k}", (x, 0.001, z), (x + 0.05, 0.709, z + 0.05), "oak"))
    chair = [
        box("chair_seat", (-0.3, 0.43, -0.75), (0.15, 0.47, -0.3), "blue"),
        box("chair_back", (0.11, 0.7, -0.74), (0.14, 0.95, -0.31), "blue"),
    ]
    for k, (x, z, high) in enumerate(
        [(-0.29, -0.74, 0.429), (-0.29, -0.35, 0.429), (0.1, -0.74, 0.95), (0.1, -0.35, 0.95)]
    ):
        chair.append(box(f"chair_leg_{k}", (x, 0.001, z), (x + 0.04, high, z + 0.04), "oak"))
    things = [
        ply("vase", "vase", "glaze", (-0.9, 0.751, -0.6)),
        ply("bowl", "fruit_bowl", "glaze", (-0.8, 0.751, 0.05)),
        box("book_0", (-1.2, 0.751, -0.2), (-1.0, 0.78, 0.08), "ochre"),
        box("book_1", (-1.19, 0.781, -0.19), (-1.01, 0.805, 0.06), "blue"),
        box("crate_0", (-0.4, 0.001, -1.95), (0.2, 0.55, -1.4), "ochre"),
        box("crate_1", (0.4, 0.001, -1.9), (0.9, 0.4, -1.45), "oak"),
    ]
    return table + chair + things


def scenes() -> dict[str, str]:
    """XML of every scene by its name."""
    return {
        "cornell_glass": cornell_glass(),
        "kitchen": kitchen_corner(),
        "tree": tree(cut_out=True),
        "tree_plain": tree(cut_out=False),
        "bricks": bricks(),
        "window": window(),
    }


def main(folder: Path) -> None:
    """Write all files of the scenes into a folder that exists."""
    write_files(folder)
    for name, text in scenes().items():
        (folder / f"{name}.xml").write_text(text)
    print(f"{len(scenes())} scenes in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
