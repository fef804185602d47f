"""The files that the whole scenes refer to: crockery, a tree, toy bricks, a curtain, and their textures."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from whole_meshes import UP, Mesh, Points, around, box, grid, joined, quad, revolved, rings, tube, unit, write

import mi_sparse_prt  # noqa: F401  (chooses Mitsuba's variant)

SEED = 11
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
BOUGHS, BRANCHES, TWIGS, LEAVES = 8, 5, 4, 20  # leaves of each branch and each twig: 4000
LEAF = (0.085, 0.05)  # length and width of a card
GROUND = 204  # cells of the tree's ground along its width
PITCH, COURSE, GAP = 0.1, 0.12, 0.003  # from stud to stud, from brick to brick, and between bricks
BRICKS = {"1x1": (1, 1), "1x2": (2, 1), "1x3": (3, 1), "1x4": (4, 1), "2x2": (2, 2)}  # studs along x and z

PROFILES = {
    "mug": [(0, 0), (0.03, 0), (0.034, 0.003), (0.038, 0.012), (0.04, 0.05), (0.04, 0.088), (0.0395, 0.0915)]
    + [(0.037, 0.0915), (0.036, 0.088), (0.036, 0.05), (0.034, 0.014), (0.028, 0.007), (0, 0.006)],
    "plate": [(0, 0), (0.065, 0), (0.07, 0.002), (0.105, 0.015), (0.115, 0.018), (0.1155, 0.0205)]
    + [(0.114, 0.022), (0.103, 0.019), (0.072, 0.007), (0.066, 0.005), (0.03, 0.005), (0, 0.005)],
    "bowl": [
        (0, 0),
        (0.034, 0),
        (0.036, 0.006),
        (0.055, 0.022),
        (0.07, 0.045),
        (0.076, 0.068),
        (0.0755, 0.071),
    ]
    + [(0.073, 0.071), (0.072, 0.068), (0.066, 0.046), (0.052, 0.026), (0.03, 0.012), (0, 0.01)],
    "fruit_bowl": [(0, 0), (0.06, 0), (0.062, 0.008), (0.1, 0.025), (0.14, 0.06), (0.16, 0.1), (0.159, 0.103)]
    + [(0.155, 0.103), (0.154, 0.1), (0.135, 0.064), (0.097, 0.032), (0.05, 0.018), (0, 0.016)],
    "glass": [
        (0, 0),
        (0.028, 0),
        (0.03, 0.002),
        (0.031, 0.012),
        (0.034, 0.06),
        (0.037, 0.115),
        (0.0365, 0.117),
    ]
    + [(0.0355, 0.117), (0.035, 0.115), (0.032, 0.06), (0.029, 0.016), (0.026, 0.012), (0, 0.012)],
    "bottle": [
        (0, 0),
        (0.034, 0),
        (0.037, 0.003),
        (0.038, 0.01),
        (0.038, 0.08),
        (0.038, 0.15),
        (0.036, 0.175),
    ]
    + [(0.028, 0.195), (0.018, 0.21), (0.014, 0.225), (0.0135, 0.26), (0.0155, 0.265), (0.0155, 0.275)]
    + [(0.014, 0.28), (0, 0.28)],
    "pot": [(0, 0), (0.1, 0), (0.108, 0.003), (0.112, 0.012), (0.112, 0.07), (0.112, 0.135), (0.1165, 0.138)]
    + [
        (0.1165, 0.141),
        (0.108, 0.141),
        (0.107, 0.138),
        (0.107, 0.07),
        (0.106, 0.01),
        (0.1, 0.006),
        (0, 0.005),
    ],
    "lid": [(0, 0), (0.113, 0), (0.1145, 0.002), (0.113, 0.005), (0.08, 0.016), (0.03, 0.023), (0.012, 0.025)]
    + [(0.009, 0.028), (0.009, 0.034), (0.016, 0.04), (0.018, 0.046), (0.014, 0.051), (0, 0.053)],
    "knob": [(0, 0), (0.007, 0), (0.0065, 0.004), (0.006, 0.012), (0.012, 0.016), (0.0155, 0.021)]
    + [(0.015, 0.026), (0.01, 0.029), (0, 0.03)],
    "disc": [(0, 0), (0.078, 0), (0.08, 0.002), (0.08, 0.008), (0.078, 0.01), (0.04, 0.01), (0, 0.01)],
    "seat": [(0, 0), (0.165, 0), (0.17, 0.004), (0.175, 0.015), (0.17, 0.03), (0.16, 0.035), (0.08, 0.033)]
    + [(0, 0.032)],
    "stand": [(0, 0), (0.07, 0), (0.074, 0.003), (0.073, 0.012), (0.06, 0.022), (0.016, 0.03), (0.011, 0.04)]
    + [(0.011, 0.2), (0.011, 0.33), (0.014, 0.335), (0, 0.337)],
    "vase": [(0, 0), (0.05, 0), (0.056, 0.004), (0.085, 0.07), (0.095, 0.13), (0.08, 0.2), (0.045, 0.25)]
    + [(0.036, 0.28), (0.045, 0.31), (0.043, 0.313), (0.04, 0.312), (0.031, 0.28), (0.038, 0.25), (0.07, 0.2)]
    + [(0.085, 0.13), (0.075, 0.07), (0.045, 0.015), (0, 0.012)],
}
SIDES = {"knob": 12, "plate": 32, "pot": 40, "lid": 40, "fruit_bowl": 32, "stand": 16}


def write_files(folder: Path) -> None:
    """All meshes and textures, into a folder that exists."""
    meshes, textures = folder / "meshes", folder / "textures"
    for place in (meshes, textures):
        place.mkdir(exist_ok=True)
    made = {name: revolved(profile, SIDES.get(name, 24)) for name, profile in PROFILES.items()}
    made["mug"] = joined([made["mug"], handle()])
    made |= tree() | {f"brick_{name}": brick(*studs) for name, studs in BRICKS.items()}
    made |= {"clearing": clearing(), "yard": yard(), "curtain": curtain(), "window_wall": window_wall()}
    made["rod"] = rod()
    for name, mesh in made.items():
        write(mesh, meshes / f"{name}.ply")
    for name, pixels in {"wood": wood(), "leaf": leaf()}.items():
        mi.Bitmap(pixels).write(str(textures / f"{name}.png"))


def handle() -> Mesh:
    """A mug's handle, whose ends are inside the mug's wall."""
    t = np.linspace(-0.5, 0.5, 11) * np.pi
    axis = np.stack([0.038 + 0.026 * np.cos(t), 0.047 + 0.027 * np.sin(t), 0 * t], axis=-1)
    return tube(axis, np.full(len(axis), 0.0055), 8, pointed=False)


def rod(length: float = 3.7) -> Mesh:
    """A closed rod along z, around the origin."""
    upright = revolved(
        [(0, 0), (0.014, 0), (0.015, 0.002), (0.015, length - 0.002), (0.014, length), (0, length)], 8
    )
    return Mesh(upright.vertices[:, [0, 2, 1]] * [-1, 1, 1] - [0, 0, length / 2], upright.triangles)


def tree() -> dict[str, Mesh]:
    """A tree's wood, and its leaves: cards with texture coordinates, in one mesh."""
    rng = np.random.default_rng(SEED)
    trunk = grown(rng, np.array([0, -0.1, 0]), unit(np.array([0.06, 1, 0.03])), 1.25, 0.075, 9)
    trunk[1][0] *= 1.5
    boughs = [
        branching(rng, trunk, share, 1.0 - 0.5 * share, 0.75 - 0.3 * share, k * GOLDEN_ANGLE)
        for k, share in enumerate(np.linspace(0.5, 0.98, BOUGHS))
    ]
    branches = [
        branching(rng, bough, share, 0.75, 0.36 - 0.1 * share, k * GOLDEN_ANGLE)
        for bough in boughs
        for k, share in enumerate(np.linspace(0.35, 0.98, BRANCHES))
    ]
    twigs = [
        branching(rng, branch, share, 0.9, 0.22, k * GOLDEN_ANGLE)
        for branch in branches
        for k, share in enumerate(np.linspace(0.3, 0.95, TWIGS))
    ]
    wooden = [tube(*trunk, 12)] + [tube(*shoot, 8) for shoot in boughs]
    wooden += [tube(*shoot, 5) for shoot in branches + twigs]
    cards = [card for shoot in branches + twigs for card in leaves(rng, *shoot)]
    return {"trunk": joined(wooden), "leaves": joined(cards)}


def grown(
    rng: np.random.Generator, start: Points, direction: Points, length: float, radius: float, steps: int
) -> tuple[Points, Points]:
    """Points of a shoot that wavers and turns to the light, and its radii there."""
    axis = [start]
    for _ in range(steps):
        direction = unit(direction + 0.13 * rng.standard_normal(3) + 0.06 * UP)
        axis.append(axis[-1] + length / steps * direction)
    return np.array(axis), radius * np.linspace(1, 0.3, steps + 1)


def branching(
    rng: np.random.Generator,
    parent: tuple[Points, Points],
    share: float,
    spread: float,
    length: float,
    angle: float,
) -> tuple[Points, Points]:
    """A shoot that leaves another one at a share of its length, at an angle around it."""
    axis, radii = parent
    k = min(int(share * (len(axis) - 1)), len(axis) - 2)
    rest = share * (len(axis) - 1) - k
    along = unit(axis[k + 1] - axis[k])
    direction = unit(along + spread * around(along, angle + rng.uniform(-0.4, 0.4)))
    start = axis[k] + rest * (axis[k + 1] - axis[k])
    return grown(rng, start, direction, length * rng.uniform(0.85, 1.15), 0.65 * radii[k], 4)


def leaves(rng: np.random.Generator, axis: Points, radii: Points) -> list[Mesh]:
    """Cards along a shoot, around it by the golden angle; their fronts turn to the sky and outwards."""
    found = []
    for k, share in enumerate(np.linspace(0.2, 1, LEAVES)):
        place = share * (len(axis) - 1)
        i = min(int(place), len(axis) - 2)
        along = unit(axis[i + 1] - axis[i])
        out = around(along, k * GOLDEN_ANGLE)
        base = axis[i] + (place - i) * (axis[i + 1] - axis[i]) + radii[i] * out
        stalk = unit(0.6 * along + out + 0.35 * rng.standard_normal(3))
        front = 0.8 * UP + 0.5 * unit(base * [1, 0, 1]) + 0.4 * rng.standard_normal(3)
        side = unit(np.cross(front, stalk))
        length, width = rng.uniform(0.8, 1.1) * np.array(LEAF)
        left, right = (base + half * width * side for half in (0.5, -0.5))
        found.append(quad([left, right, right + length * stalk, left + length * stalk]))
    return found


def clearing(half: float = 2.4) -> Mesh:
    """The tree's ground: a square of low mounds."""
    x, z = np.meshgrid(*[np.linspace(-half, half, GROUND + 1)] * 2)
    height = 0.05 * np.sin(1.7 * x + 0.6) * np.cos(1.4 * z - 0.3) + 0.02 * np.sin(4.1 * z + 2.2 * x)
    height += 0.006 * np.sin(11 * x - 3 * z) * np.cos(9 * z + 4 * x) - 0.03
    return grid(
        np.stack([x, height, z], axis=-1)[::-1]
    )  # seen from above, columns go right (x) and rows go up (-z)


def yard(half: float = 4, cells: int = 48) -> Mesh:
    """The bricks' flat ground."""
    x, z = np.meshgrid(*[np.linspace(-half, half, cells + 1)] * 2)
    return grid(np.stack([x, 0 * x, z], axis=-1)[::-1])


def brick(width: int, depth: int, sides: int = 6) -> Mesh:
    """A brick of so many studs along x and z: a closed box on the ground, around the vertical axis, and its studs."""
    top = COURSE - GAP
    far = np.array([(width * PITCH - GAP) / 2, top, (depth * PITCH - GAP) / 2])
    body = box(far * [-1, 0, -1], far)
    parts = [Mesh(body.vertices, body.triangles)]
    for x in range(width):
        for z in range(depth):
            centre = PITCH * np.array([x + 0.5 - width / 2, 0, z + 0.5 - depth / 2])
            parts.append(stud(sides, centre + top * UP))
    return joined(parts)


def stud(sides: int, base: Points, radius: float = 0.033, height: float = 0.022) -> Mesh:
    """A cylinder without bottom; its lid has vertices of its own, so that its edge is sharp."""
    angles = -2 * np.pi * np.arange(sides) / sides
    circle = base + radius * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1)
    lid = circle + height * UP
    fan = np.stack([np.zeros(sides - 2, int), np.arange(1, sides - 1), np.arange(2, sides)], axis=-1)
    return joined([rings(np.stack([circle, lid])), Mesh(lid, fan)])


def curtain(width: float = 0.75, height: float = 2.1) -> Mesh:
    """A sheet in folds that hangs from the origin along z, and faces +x."""
    y, s = np.meshgrid(np.linspace(-height, 0, 22), np.linspace(0, 1, 73), indexing="ij")
    loose = 1 + 0.25 * y / height
    fold = 0.045 * np.sin(2 * np.pi * (7 * s + 0.12 * np.sin(3 * y + 4 * s))) / loose
    z = width * (s - 0.5) * loose + 0.02 * np.sin(14 * np.pi * s)
    return grid(np.stack([fold, y, -z], axis=-1))


def window_wall() -> Mesh:
    """A wall 0.2 thick across x, with an opening: closed, its reveals included. Its inner side is at x = 0."""
    y, z = np.array([-0.05, 0.7, 2.35, 2.65]), np.array([-2.05, -1.4, 1.1, 2.05])
    sides = []
    for x in (0.0, -0.2):
        cells = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        for i, j in cells:
            corners = [[x, y[i + a], z[j + b]] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
            sides.append(quad(corners if x == 0 else corners[::-1]))
    for low, high, inside in ((1, 2, True), (0, 3, False)):  # the reveals, and around the wall
        loop = [(y[low], z[low]), (y[high], z[low]), (y[high], z[high]), (y[low], z[high])]
        for (y0, z0), (y1, z1) in zip(loop, loop[1:] + loop[:1], strict=True):
            corners = [[0, y0, z0], [0, y1, z1], [-0.2, y1, z1], [-0.2, y0, z0]]
            sides.append(quad(corners if inside else corners[::-1]))
    return joined([Mesh(side.vertices, side.triangles) for side in sides])


def wood(size: int = 256, planks: int = 4) -> NDArray[np.uint8]:
    """Planks along the rows of an image (size, size, 3), with grain and dark joints; it tiles."""
    rng = np.random.default_rng(SEED)
    y, x = np.mgrid[0.5:size, 0.5:size] / size
    row = (y * planks).astype(int)
    across = y * planks - row
    shift = rng.uniform(0, 1, planks)[row]
    along = (x + shift) % 1
    half = (along < 0.5).astype(int)
    tone = rng.uniform(0.75, 1.1, (planks, 2))[row, half]
    bend = 0.35 * np.sin(2 * np.pi * (along + shift)) + 0.15 * np.sin(6 * np.pi * along + 5 * shift)
    grain = 0.6 * np.sin(2 * np.pi * (5 * across + bend)) + 0.4 * np.sin(2 * np.pi * (13 * across + 2 * bend))
    speckle = rng.standard_normal((size, size // 16)).repeat(16, axis=1)
    joint = (np.minimum(across, 1 - across) < 0.03) | (np.minimum(along % 0.5, 0.5 - along % 0.5) < 0.004)
    light = tone * (1 + 0.1 * grain + 0.04 * speckle) * np.where(joint, 0.35, 1)
    return np.clip(np.round(light[..., None] * [176, 122, 74]), 0, 255).astype(np.uint8)


def leaf(size: int = 64) -> NDArray[np.uint8]:
    """A leaf's outline (size, size, 1), white where there is leaf. Its stalk is in the first row, where v is 0."""
    y, x = np.mgrid[0.5:size, 0.5:size] / size
    half = 0.46 * np.sin(np.pi * np.clip((y - 0.08) / 0.92, 0, 1) ** 0.8) ** 0.9
    half += 0.02 * np.cos(36 * y) * (half > 0.1)
    stalk = (y < 0.15) & (np.abs(x - 0.5) < 0.03)
    return np.where((np.abs(x - 0.5) < half) | stalk, 255, 0).astype(np.uint8)[..., None]
