"""Parts of scenes as XML: the frame that all share, BSDFs, and shapes where they stand."""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]

FRAME = """<!-- {title} Written by make_whole.py. -->
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="max_depth" value="{view.max_depth}"/>
    <default name="width" value="320"/>
    <default name="height" value="240"/>
    <default name="spp" value="64"/>
    <default name="environment" value="../envmaps/{view.environment}.exr"/>
    <default name="rotation" value="{view.rotation:g}"/>

    <integrator type="$integrator">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective" id="camera">
        <float name="fov" value="{view.fov:g}"/>
        <transform name="to_world">
            <lookat origin="{origin}" target="{target}" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
    </sensor>

    <emitter type="envmap" id="environment">
        <string name="filename" value="$environment"/>
        <float name="scale" value="{view.brightness:g}"/>
        <transform name="to_world">
            <rotate y="1" angle="$rotation"/>
        </transform>
    </emitter>

{content}
</scene>
"""


@dataclass(frozen=True)
class View:
    """How a scene is looked at, and its environment.

    Attributes
    ----------
    origin, target : tuple of float
        Of the camera.
    fov : float
        Degrees, across the width.
    environment : str
        A file of ``scenes_xml/envmaps``, without its ending.
    rotation : float
        Degrees that the environment is turned by, about the vertical axis.
    brightness : float
        What the environment is multiplied by.
    max_depth : int
        Of the integrator.
    """

    origin: Triple
    target: Triple
    fov: float
    environment: str
    rotation: float = 0
    brightness: float = 1
    max_depth: int = 6


def scene(title: str, view: View, *parts: str) -> str:
    """A whole scene file; `title` is a sentence."""
    origin, target = triple(view.origin), triple(view.target)
    content = indented("\n".join(parts))
    return FRAME.format(title=title, view=view, origin=origin, target=target, content=content)


def indented(text: str, depth: int = 1) -> str:
    """Lines shifted to the right by ``depth`` steps."""
    return "\n".join("    " * depth + line if line else line for line in text.splitlines())


def number(value: float) -> str:
    """As short as it is exact to 0.1 mm, where a unit is a metre."""
    return f"{round(value, 4) + 0.0:g}"


def triple(values: Triple) -> str:
    """Three numbers as an attribute's value."""
    return ", ".join(map(number, values))


def rgb(name: str, *values: float) -> str:
    """A colour."""
    return f'<rgb name="{name}" value="{", ".join(map(number, values))}"/>'


def value(name: str, of: float) -> str:
    """A number with a name."""
    return f'<float name="{name}" value="{number(of)}"/>'


def material(name: str) -> str:
    """A conductor's metal; ``none`` is a perfect mirror."""
    return f'<string name="material" value="{name}"/>'


def bitmap(name: str, file: str, repeat: tuple[float, float] = (1, 1), raw: bool = False) -> str:
    """A texture of an image, so many times along a surface's width and height."""
    lines = [f'<string name="filename" value="{file}"/>']
    if raw:
        lines.append('<boolean name="raw" value="true"/>')
    if repeat != (1, 1):
        x, y = map(number, repeat)
        lines.append(f'<transform name="to_uv">\n    <scale x="{x}" y="{y}"/>\n</transform>')
    return element("texture", f'name="{name}" type="bitmap"', *lines)


def element(tag: str, attributes: str, *content: str) -> str:
    """An XML element with something in it."""
    return f"<{tag} {attributes}>\n{indented(chr(10).join(content))}\n</{tag}>"


def bsdf(kind: str, name: str, *content: str) -> str:
    """A BSDF with an id; a name that is empty leaves the id out."""
    attributes = f'type="{kind}"' + (f' id="{name}"' if name else "")
    return element("bsdf", attributes, *content) if content else f"<bsdf {attributes}/>"


def diffuse(name: str, *colour: float) -> str:
    """A diffuse BSDF of one side."""
    return bsdf("diffuse", name, rgb("reflectance", *colour))


def twosided(name: str, *colour: float) -> str:
    """A diffuse BSDF of two sides."""
    return bsdf("twosided", name, diffuse("", *colour))


def glossy(kind: str, name: str, *colour: float, alpha: float | None = None) -> str:
    """A (rough) plastic."""
    roughness = [] if alpha is None else [value("alpha", alpha)]
    return bsdf(kind, name, rgb("diffuse_reflectance", *colour), *roughness)


def shape(kind: str, name: str, *content: str) -> str:
    """A shape with an id."""
    return element("shape", f'type="{kind}" id="{name}"', *content)


def ref(name: str) -> str:
    """The BSDF or group of a name."""
    return f'<ref id="{name}"/>'


def box(name: str, low: Triple, high: Triple, look: str) -> str:
    """A closed box between two corners, with a BSDF by its name."""
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    centre = [(b + a) / 2 for a, b in zip(low, high, strict=True)]
    lines = [f"<{tag} {axes(*v)}/>" for tag, v in (("scale", half), ("translate", centre))]
    return shape("cube", name, element("transform", 'name="to_world"', *lines), ref(look))


def axes(x: float, y: float, z: float) -> str:
    """Three numbers as attributes."""
    return f'x="{number(x)}" y="{number(y)}" z="{number(z)}"'


def ply(name: str, file: str, look: str, at: Triple = (0, 0, 0), turn: float = 0) -> str:
    """A mesh from ``meshes``, turned about the vertical axis by degrees and put somewhere."""
    lines = [f'<string name="filename" value="meshes/{file}.ply"/>']
    moves = [f'<rotate y="1" angle="{number(turn)}"/>'] if turn else []
    moves += [f"<translate {axes(*at)}/>"] if any(at) else []
    if moves:
        lines.append(element("transform", 'name="to_world"', *moves))
    return shape("ply", name, *lines, ref(look))


def sphere(name: str, centre: Triple, radius: float, *look: str) -> str:
    """A sphere with what it looks like: a reference, or an emitter."""
    return shape("sphere", name, f'<point name="center" {axes(*centre)}/>', value("radius", radius), *look)


def rectangle(name: str, look: str, *moves: str) -> str:
    """A square from -1 to 1 that faces +z, after moves, with a BSDF by its name."""
    return shape(
        "rectangle", name, element("transform", 'name="to_world"', *moves), *([ref(look)] if look else [])
    )


def area(*radiance: float) -> str:
    """An emitter of a shape."""
    return element("emitter", 'type="area"', rgb("radiance", *radiance))
