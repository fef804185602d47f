"""Scenes that nobody has chosen: rooms, product shots, landscapes and courtyards, drawn at random.

    python docs/random_scenes.py FOLDER [--first 0] [--count 8]
    mi-sparse-prt benchmark FOLDER --zoo --figures FOLDER/sheet --json FOLDER/zoo.json

Scene k is the same whenever it is made, and k mod 4 is its kind. What is changed in the code is shown on numbers that
no one has seen before.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

Transform = mi.scalar_rgb.ScalarTransform4f
SCENES = Path(__file__).parents[1] / "scenes_xml"
ENVIRONMENTS = ("city", "dawn", "forest", "studio", "sunset", "venice", "workshop_negative")
# file, where it stands and how high it is, in its own units
MODELS = {
    "bunny.ply": ((-0.017, 0.033, 0.0), 0.154),
    "dancer.ply": ((0.27, 0.0, 0.0), 1.96),
    "spot.obj": ((0.0, -0.737, 0.19), 1.69),
    "teapot.obj": ((0.2, 0.0, 0.0), 3.15),
}
METALS = ("Au", "Cu", "Al", "Cr")

Entry = dict[str, Any]


class Draw:
    """What is drawn for one scene."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def between(self, low: float, high: float) -> float:
        """Evenly."""
        return float(self.rng.uniform(low, high))

    def one_of(self, choices: Any) -> Any:
        """Evenly."""
        return choices[int(self.rng.integers(len(choices)))]

    def colour(self, low: float = 0.1, high: float = 0.85) -> Entry:
        """A reflectance."""
        return {"type": "rgb", "value": [self.between(low, high) for _ in range(3)]}

    def plain(self) -> Entry:
        """What walls and grounds are made of: diffuse, one-sided or not, textured or not."""
        reflectance = self.colour(0.4, 0.85)
        if self.rng.random() < 0.3:
            reflectance = {
                "type": "checkerboard",
                "color0": self.colour(0.05, 0.5),
                "color1": self.colour(0.5, 0.9),
                "to_uv": Transform().scale(self.between(2, 8)),
            }
        matte = {"type": "diffuse", "reflectance": reflectance}
        return matte if self.rng.random() < 0.5 else {"type": "twosided", "inside": matte}

    def material(self) -> Entry:
        """What things are made of."""
        alpha = self.between(0.08, 0.5)
        kind = self.one_of(
            ("diffuse", "diffuse", "plastic", "roughplastic", "roughconductor", "conductor", "dielectric")
            + ("principled", "roughdielectric", "thindielectric", "blend")
        )
        if kind == "diffuse":
            return self.plain()
        if kind in ("plastic", "roughplastic"):
            rough = {"alpha": alpha} if kind == "roughplastic" else {}
            return {"type": kind, "diffuse_reflectance": self.colour(), **rough}
        if kind in ("roughconductor", "conductor"):
            rough = {"alpha": alpha} if kind == "roughconductor" else {}
            return {"type": "twosided", "inside": {"type": kind, "material": self.one_of(METALS), **rough}}
        if kind == "roughdielectric":
            return {"type": kind, "alpha": alpha}
        if kind == "principled":
            shares = {"roughness": self.between(0.3, 1), "metallic": self.one_of((0.0, 0.0, 1.0))}
            return {"type": kind, "base_color": self.colour(), "specular": self.between(0.2, 0.8), **shares}
        if kind == "blend":
            other = {"type": "roughplastic", "diffuse_reflectance": self.colour(), "alpha": alpha}
            below = {"type": "diffuse", "reflectance": self.colour()}
            return {"type": "blendbsdf", "weight": self.between(0.2, 0.8), "first": below, "second": other}
        return {"type": kind}

    def thing(self, x: float, y: float, z: float, size: float, material: Entry | None = None) -> Entry:
        """Something of this size that stands at a place."""
        bsdf, name = material or self.material(), self.one_of((*MODELS, "sphere", "cube", "cylinder"))
        turned = Transform().translate([x, y, z]).rotate([0, 1, 0], self.between(0, 360))
        if name in MODELS:
            foot, height = MODELS[name]
            to_world = turned.scale(size / height).translate([-foot[0], -foot[1], -foot[2]])
            file = str(SCENES / "meshes" / name)
            return {"type": name[-3:], "filename": file, "to_world": to_world, "bsdf": bsdf}
        half = turned.scale(size / 2)
        if name == "cylinder":
            to_world = half.rotate([1, 0, 0], -90).scale([0.5, 0.5, 2])
            return {"type": name, "to_world": to_world, "bsdf": {"type": "twosided", "b": {**DULL}}}
        return {"type": name, "to_world": half.translate([0, 1, 0]), "bsdf": bsdf}

    def lamp(self, x: float, y: float, z: float) -> Entry:
        """A lamp at a place, that shines downwards if it has a direction."""
        power = {"type": "rgb", "value": [self.between(2, 12) for _ in range(3)]}
        at = Transform().translate([x, y, z])
        kind = self.one_of(("area", "sphere", "point", "spot"))
        if kind == "area":
            panel = at.rotate([1, 0, 0], 90).scale(self.between(0.1, 0.4))
            return {"type": "rectangle", "to_world": panel, "light": {"type": "area", "radiance": power}}
        if kind == "sphere":
            return {
                "type": "sphere",
                "to_world": at.scale(0.08),
                "light": {"type": "area", "radiance": power},
            }
        if kind == "point":
            return {"type": "point", "position": [x, y, z], "intensity": power}
        aim = Transform().look_at([x, y, z], [x * 0.5, 0, z * 0.5], [0.01, 0, 1])
        return {"type": "spot", "to_world": aim, "intensity": power, "cutoff_angle": self.between(20, 60)}

    def sky(self, scale: float = 1.0) -> Entry:
        """An environment, turned."""
        if self.rng.random() < 0.15:
            return {"type": "constant", "radiance": {"type": "rgb", "value": [scale] * 3}}
        turn = Transform().rotate([0, 1, 0], self.between(0, 360))
        file = str(SCENES / "envmaps" / f"{self.one_of(ENVIRONMENTS)}.exr")
        return {"type": "envmap", "filename": file, "scale": scale, "to_world": turn}

    def view(self, origin: list[float], target: list[float], fov: float) -> Entry:
        """A camera."""
        return {
            "type": "perspective",
            "fov": fov,
            "to_world": Transform().look_at(origin, target, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 160, "height": 120, "rfilter": {"type": "box"}},
        }


DULL = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}


def room(draw: Draw) -> Entry:
    """Four walls with a window in one, things on the floor and on a table, sometimes a lamp."""
    wide, high, deep = draw.between(1.2, 2.2), draw.between(2.2, 3), draw.between(1.2, 2.2)
    wall = {"type": "twosided", "inside": {"type": "diffuse", "reflectance": draw.colour(0.55, 0.85)}}
    left, low, top = draw.between(0.3, 0.7) * deep, draw.between(0.5, 1), draw.between(1.7, 2.1)

    def panel(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, bsdf: Entry = wall) -> Entry:
        middle, half = np.array([x0 + x1, y0 + y1, z0 + z1]) / 2, np.array([x1 - x0, y1 - y0, z1 - z0]) / 2
        to_world = Transform().translate(middle.tolist()).scale(half.tolist())
        return {"type": "cube", "to_world": to_world, "bsdf": bsdf}

    t = 0.05
    scene = {
        "floor": panel(-wide, wide, -t, 0, -deep, deep, draw.plain()),
        "ceiling": panel(-wide, wide, high, high + t, -deep, deep),
        "back": panel(-wide, wide, 0, high, -deep - t, -deep),
        "front": panel(-wide, wide, 0, high, deep, deep + t),
        "right": panel(wide, wide + t, 0, high, -deep, deep),
        "below": panel(-wide - t, -wide, 0, low, -deep, deep),
        "above": panel(-wide - t, -wide, top, high, -deep, deep),
        "beside": panel(-wide - t, -wide, low, top, -deep, -left),
        "beside_too": panel(-wide - t, -wide, low, top, left, deep),
        "table": panel(-0.5, 0.5, 0.68, 0.72, -0.4, 0.4, draw.material()),
        "leg": panel(-0.05, 0.05, 0, 0.68, -0.05, 0.05),
        "on_table": draw.thing(
            draw.between(-0.3, 0.3), 0.72, draw.between(-0.2, 0.2), draw.between(0.15, 0.4)
        ),
        "on_floor": draw.thing(draw.between(0.6, wide - 0.3), 0, -deep + 0.5, draw.between(0.4, 1)),
        "sky": draw.sky(draw.between(3, 8)),
        "sensor": draw.view([wide - 0.2, draw.between(1.2, 1.7), deep - 0.2], [-0.2, 0.8, -0.3], 65),
    }
    if draw.rng.random() < 0.5:
        pane = Transform().translate([-wide, (low + top) / 2, 0]).rotate([0, 1, 0], 90)
        to_world = pane.scale([left, (top - low) / 2, 1])
        scene["pane"] = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "thindielectric"}}
    if draw.rng.random() < 0.5:
        scene["lamp"] = draw.lamp(0, high - 0.1, 0)
    return scene


def product(draw: Draw) -> Entry:
    """One to three things before a backdrop, lit by a sky and sometimes a panel."""
    turned = Transform().translate([0, 0, -1.2]).scale(3)
    scene = {
        "ground": {
            "type": "rectangle",
            "to_world": Transform().rotate([1, 0, 0], -90).scale(3),
            "bsdf": draw.material() if draw.rng.random() < 0.3 else draw.plain(),
        },
        "backdrop": {"type": "rectangle", "to_world": turned, "bsdf": draw.plain()},
        "sky": draw.sky(),
        "sensor": draw.view([0.3, draw.between(0.6, 1.4), 2.8], [0, 0.35, 0], draw.between(30, 42)),
    }
    count = int(draw.rng.integers(1, 4))
    for k in range(count):
        scene[f"thing_{k}"] = draw.thing(0.75 * (k - (count - 1) / 2), 0, 0, draw.between(0.5, 0.9))
    if draw.rng.random() < 0.5:
        scene["lamp"] = draw.lamp(-1, 1.8, 0.8)
    return scene


def landscape(draw: Draw) -> Entry:
    """A wavy ground with instanced things on it, under a sky or a sun."""
    scene: Entry = {
        "ground": {
            "type": "ply",
            "filename": str(SCENES / "meshes" / "meadow.ply"),
            "to_world": Transform().scale([3, 2, 3]),
            "bsdf": draw.plain(),
        },
        "group": {"type": "shapegroup", "thing": draw.thing(0, 0, 0, 1.0)},
        "sensor": draw.view([0, draw.between(1, 2.5), 6.5], [0, 0.3, 0], 40),
    }
    for k in range(int(draw.rng.integers(5, 60))):
        at = Transform().translate([draw.between(-4, 4), 0.1, draw.between(-4, 3)])
        to_world = at.rotate([0, 1, 0], draw.between(0, 360)).scale(draw.between(0.3, 0.9))
        scene[f"instance_{k}"] = {
            "type": "instance",
            "to_world": to_world,
            "group": {"type": "ref", "id": "group"},
        }
    if draw.rng.random() < 0.3:
        scene["sun"] = {"type": "directional", "direction": [draw.between(-1, 1), -1, draw.between(-1, 0)]}
    scene["sky"] = draw.sky()
    return scene


def courtyard(draw: Draw) -> Entry:
    """Walls around a ground that is open to the sky, a colonnade and things within."""
    ground = draw.plain()
    scene = {
        "ground": {
            "type": "rectangle",
            "to_world": Transform().rotate([1, 0, 0], -90).scale(3),
            "bsdf": ground,
        },
        "sky": draw.sky(),
        "sensor": draw.view([1.6, draw.between(1, 1.8), 2.6], [-0.3, 0.6, -0.6], 60),
    }
    wall = draw.plain()
    for k, (x, z) in enumerate(((-3.0, 0.0), (3.0, 0.0), (0.0, -3.0))):
        to_world = Transform().translate([x, 1, z]).scale([0.1 if x else 3, 1, 0.1 if z else 3])
        scene[f"wall_{k}"] = {"type": "cube", "to_world": to_world, "bsdf": wall}
    for k in range(int(draw.rng.integers(2, 7))):
        foot, head = [-2 + 0.8 * k, 0, -1.8], [-2 + 0.8 * k, 1.6, -1.8]
        scene[f"column_{k}"] = {"type": "cylinder", "p0": foot, "p1": head, "radius": 0.12, "bsdf": {**DULL}}
    scene["lintel"] = {
        "type": "cube",
        "to_world": Transform().translate([0, 1.7, -1.8]).scale([2.8, 0.1, 0.2]),
        "bsdf": wall,
    }
    for k in range(int(draw.rng.integers(1, 4))):
        scene[f"thing_{k}"] = draw.thing(draw.between(-1.5, 1), 0, draw.between(-1, 1), draw.between(0.3, 1))
    return scene


KINDS: tuple[Callable[[Draw], Entry], ...] = (room, product, landscape, courtyard)


def main() -> None:
    """Write scene files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=8)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for k in range(options.first, options.first + options.count):
        kind = KINDS[k % len(KINDS)]
        scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 6}, **kind(Draw(k))}
        path = options.folder / f"{k:03d}_{kind.__name__}.xml"
        config = mi.parser.ParserConfig("scalar_rgb")
        mi.parser.write_file(mi.parser.parse_dict(config, scene), str(path))
        print(path)


if __name__ == "__main__":
    mi.set_variant("scalar_rgb")
    main()
