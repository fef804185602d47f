"""The result: a factored light transport matrix T ([HR10] eq. 1), stored in incident form ([Leh07] 2.4).

T = R (V + S V): operators keep unit-albedo transport, what a point of albedo 1 would send out, and the reflection makes
radiance of it. Direct light needs one channel and no more than its visibility; indirect light is smooth and may have
fewer directions; colour exists only where the scene has any.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
import psutil
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.emitters import StoredEmitters
from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.io.store import write_store
from mi_sparse_prt.measurement.measurement import Measurement, MeshRange, mesh_vertices
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.stored import operator_arrays
from mi_sparse_prt.operators.sum import Sum, add
from mi_sparse_prt.reflection.brdf_factors import harmonic_factors
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.scene.scene import Scene

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator
    from xarray import DataArray

FORMAT = "mi_sparse_prt light transport matrix"
VERSION = 7
TOGETHER = 96  # lights of a block: results of many more are fresh memory each time, which takes longer

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Coefficients:
    """What one lighting makes of a glossy scene.

    Attributes
    ----------
    unit_albedo : (n, 3) float32
        Irradiance / pi of each point.
    terms : (n, K, 3) float32
        B_k; zeros at points that are not glossy.
    """

    unit_albedo: Floats
    terms: Floats


@dataclass(frozen=True)
class LightTransport:
    """A precomputed light transport matrix T (n, n_directions, 3), factored.

    Attributes
    ----------
    emission : EmissionSpace
        E: the columns.
    basis : {"direction", "texel"}
    max_depth : int
        As Mitsuba's ``path``: 2 is direct light only, -1 no limit.
    measurement : Measurement
        M: the points of the rows.
    reflection : Reflection
        R.
    operators : mapping of str to Operator
        V and S, unit-albedo transport: ``"direct"`` and, where there is such light, ``"indirect"``; a compressed matrix
        has ``"compressed"``, both together. Their sum is ``incident``.
    scene_hash : str
    report : dict
        What was done, skipped, how long it took and how good it is; JSON as it is.
    dense_vertices : (k,) int64, optional
        Ascending: vertices whose rows were sampled themselves, and from which those of others follow ([HR10] 4.1). None
        where all vertices were treated alike, and of files that were written before this was kept.
    """

    emission: EmissionSpace
    basis: str
    max_depth: int
    measurement: Measurement
    reflection: Reflection
    operators: Mapping[str, Operator]
    scene_hash: str
    report: dict[str, Any] = field(default_factory=dict)
    dense_vertices: NDArray[np.int64] | None = None

    def __repr__(self) -> str:
        """One line: what it is of, and how well it is known; its arrays may have billions of numbers."""
        parts = ", ".join(f"{name}: {type(operator).__name__}" for name, operator in self.operators.items())
        error = (self.report.get("estimated_error") or {}).get("total")
        known = "" if error is None else f", estimated error {error:.2%}"
        return (
            f"{type(self).__name__}({self.measurement!r} x {self.emission!r}, {parts}, "
            f"{self.nbytes / 1e6:.1f} MB{known})"
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(outputs of the measurement, elements of the emission space, 3)."""
        return self.measurement.outputs, self.emission.size, 3

    @property
    def nbytes(self) -> int:
        """Bytes of the stored factors."""
        return sum(operator.nbytes for operator in self.operators.values())

    @property
    def lighting(self) -> Any:
        """``emission``."""
        return self.emission

    @property
    def albedo(self) -> Floats:
        """(n, 3) float32, of the diffuse part of each point."""
        return self.reflection.albedo

    @property
    def direct(self) -> Operator:
        """``operators["direct"]``; a compressed matrix has none (``incident`` is what every matrix has)."""
        return self.operators["direct"]

    @property
    def indirect(self) -> Operator | None:
        """``operators["indirect"]``, None where there is no such light."""
        return self.operators.get("indirect")

    @property
    def meshes(self) -> tuple[MeshRange, ...]:
        """``measurement.groups``."""
        return self.measurement.groups

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of lamps in the order of columns: an area light's mesh, another's id or kind; none of a cubemap."""
        return tuple(map(str, self.emission.coordinates.get("lamp", ())))

    @property
    def terms(self) -> int:
        """K of its glossy points, 0 where all are diffuse."""
        return self.reflection.terms

    @cached_property
    def incident(self) -> Operator:
        """The sum of the operators: unit-albedo rows of all points, then terms of the glossy ones."""
        operators = tuple(self.operators.values())
        return operators[0] if len(operators) == 1 else Sum(operators)

    @property
    def T(self) -> TransposedTransport:
        """The transposed operator; nothing is expanded."""
        return TransposedTransport(self)

    def rows(self, ids: ArrayLike) -> Floats:
        """Rows of T: radiosity / pi of points under light from each texel alone; of a diffuse one its radiance.

        Parameters
        ----------
        ids : (k,) integers
            Points.

        Returns
        -------
        (k, n_directions, 3) float32

        Raises
        ------
        PrtError
            If an index is out of range.
        """
        measurement, reflection = self.measurement, self.reflection
        chosen = _checked(
            ids, measurement.outputs, {"vertices": "vertex", "pixels": "pixel"}.get(measurement.kind, "row")
        )
        if measurement.weights is None:
            return reflection.radiosity(self.incident.rows(reflection.rows_of(chosen)), chosen)
        weights = measurement.weights[chosen]
        points = np.unique(weights.indices)
        rows = reflection.radiosity(self.incident.rows(reflection.rows_of(points)), points)
        flat = weights[:, points] @ rows.reshape(len(points), -1)
        return flat.reshape(len(chosen), *rows.shape[1:])

    def columns(self, ids: ArrayLike) -> Floats:
        """Columns of T: radiosity / pi of all points under light from one texel each.

        Parameters
        ----------
        ids : (k,) integers
            Texels.

        Returns
        -------
        (n, k, 3) float32

        Raises
        ------
        PrtError
            If an index is out of range.
        """
        chosen = _checked(ids, self.emission.size, "direction")
        return self.measurement.combined(self.reflection.radiosity(self.incident.columns(chosen)))

    def irradiance(self, lighting: Any) -> Floats:
        """What would leave points of albedo 1: irradiance / pi, (n, 3) float32 (see ``relight``)."""
        return self._incident_light(lighting)[: len(self.measurement)]

    def irradiance_by_depth(self, lighting: Any) -> Floats:
        """``irradiance`` of light that met at most 0, 1, ... surfaces: (k, n, 3) float32, all of it last.

        Only that where light is not told apart by depth: k is 1.
        """
        return self._by_depth(lighting)[:, : len(self.measurement)]

    def relight(self, lighting: Any, outgoing: ArrayLike | None = None) -> Floats:
        """B = T L: light leaving the points under an environment.

        Parameters
        ----------
        lighting : Environment, str, or (n_directions, 3) float
            An environment is projected to the cubemap first.
        outgoing : (n, 3) or (3,) float, world, optional
            Directions in which light leaves.

        Returns
        -------
        (n, 3) float32
            Radiance towards ``outgoing``; without it radiosity / pi, which is the radiance of a diffuse point.
        """
        return self.leaving(self._incident_light(lighting), outgoing)

    def relight_many(
        self,
        lights: ArrayLike | Iterable[Any],
        into: Callable[[int, Floats], object] | Any = None,
        together: int = TOGETHER,
    ) -> Floats | None:
        """Radiosity / pi under many lights, some at a time: a year of skies, or one light after the other.

        Parameters
        ----------
        lights : (n_directions, 3, k) float, or iterable
            All L at once; or one after the other, as ``relight`` takes them: these need not be in memory together.
        into : callable or array, optional
            ``into(first, colours)`` is called for lights from number ``first`` on, with (n, 3, some) float32. Or an
            array (n, 3, k) that takes ``into[:, :, first:last] = colours``, such as one of half floats or of Zarr.
        together : int
            Lights of a block: memory is that of a few arrays (n, 3, together).

        Returns
        -------
        (n, 3, k) float32
            Without ``into``; else None.

        Raises
        ------
        PrtError
            If ``together`` is below 1, or a light is not one of this matrix.
        """
        if together < 1:
            raise PrtError(f"{together} lights together: give 1 or more")
        found: list[Floats] = []
        for first, block in _blocks_of(self.emission, lights, together):
            colours = self.apply(block)
            if into is None:
                found.append(colours)
            elif callable(into):
                into(first, colours)
            else:
                into[:, :, first : first + colours.shape[2]] = colours
        if into is not None:
            return None
        return np.concatenate(found, axis=2) if found else np.zeros((self.shape[0], 3, 0), np.float32)

    def leaving(self, incident: Floats, outgoing: ArrayLike | None = None) -> Floats:
        """What leaves points whose incident light (rows, 3) is known; ``outgoing`` and result as of ``relight``."""
        if outgoing is None or not isinstance(self.reflection, InOutFactors):
            return self.measurement.combined(self.reflection.radiosity(incident))
        towards = np.broadcast_to(np.asarray(outgoing, np.float32), self.reflection.normals.shape)
        return self.measurement.combined(self.reflection.radiance(incident, towards))

    def coefficients(self, lighting: Any) -> Coefficients:
        """Irradiance / pi and terms of all points under an environment or L (n_directions, 3)."""
        return self._coefficients(self._incident_light(lighting))

    def coefficients_by_depth(self, lighting: Any) -> list[Coefficients]:
        """``coefficients`` of light that met at most 0, 1, ... surfaces (``irradiance_by_depth``)."""
        return [self._coefficients(found) for found in self._by_depth(lighting)]

    def _coefficients(self, found: Floats) -> Coefficients:
        """From the light (rows, 3) of all rows."""
        n = len(self.measurement)
        terms = np.zeros((n, self.terms, 3), np.float32)
        terms[self.reflection.glossy] = found[n:].reshape(-1, self.terms, 3)
        return Coefficients(found[:n], terms)

    def _by_depth(self, lighting: Any) -> Floats:
        """Light (k, rows, 3) that met at most 0, 1, ... surfaces."""
        known, found = self.emission.project(lighting), dict[int, list[Floats]]()
        for operator in self.operators.values():
            terms = enumerate(operator.by_depth, 1) if operator.by_depth else [(0, operator)]
            for depth, term in terms:
                found.setdefault(depth, []).append(term.relight(known))
        return np.cumsum([add(found[depth]) for depth in sorted(found)], axis=0)

    def _incident_light(self, lighting: Any) -> Floats:
        """Of all rows, (rows, 3)."""
        return self.incident.relight(self.emission.project(lighting))

    def apply(self, x: Floats) -> Floats:
        """Products T x: (n_directions, 3, k) to (n, 3, k), radiosity / pi; each channel has its own vectors."""
        incident = np.moveaxis(self.incident.apply(x), 1, 2)  # [row, k, channel]
        outgoing = self.measurement.combined(self.reflection.radiosity(incident))
        return np.ascontiguousarray(np.moveaxis(outgoing, 2, 1))

    def adjoint(self, y: Floats) -> Floats:
        """Products of the transpose: (n, 3, k) to (n_directions, 3, k)."""
        outgoing = self.measurement.combined_adjoint(np.asarray(y, np.float32))
        return self.incident.adjoint(self.reflection.radiosity_adjoint(outgoing))

    def to_xarray(self, ids: ArrayLike | None = None) -> DataArray:
        """Rows of T with names for all that they hold, for notebooks; needs the package ``xarray``.

        Parameters
        ----------
        ids : (k,) integers, optional
            As for ``rows``; all of them if not given, which are 4 x 3 x n x n_directions bytes.

        Returns
        -------
        xarray.DataArray
            Dimensions ``row``, ``element`` and ``channel``. Coordinates: ``id`` and ``group`` (mesh or image) of rows;
            of elements what the emission space calls them; ``attrs`` has the parameters of the precomputation.

        Raises
        ------
        PrtError
            If xarray is not installed, an index is out of range, or there is not enough memory.
        """
        try:
            from xarray import DataArray
        except ImportError:
            raise PrtError("to_xarray needs the package xarray: pip install xarray") from None
        chosen = np.arange(self.shape[0]) if ids is None else np.asarray(ids)
        needed = 4.0 * len(chosen) * self.shape[1] * self.shape[2]
        if needed > psutil.virtual_memory().available:
            raise PrtError(f"to_xarray: {len(chosen)} rows are {needed / 1e9:.1f} GB; ask for some rows")
        elements = {name: ("element", values) for name, values in self.emission.coordinates.items()}
        return DataArray(
            self.rows(chosen),
            dims=("row", "element", "channel"),
            coords={
                "id": ("row", chosen),
                "group": ("row", self.measurement.group_names[chosen]),
                "channel": ["r", "g", "b"],
                **elements,
            },
            name="T",
            attrs={"basis": self.basis, **self.report.get("parameters", {})},
        )

    def as_linear_operator(self, channel: int | None = None) -> LinearOperator:
        """T for SciPy's iterative methods.

        Parameters
        ----------
        channel : {0, 1, 2}, optional
            (n, n_directions) of one channel. Without it all three, block-diagonal (3 n, 3 n_directions): vectors are
            those of red, of green and of blue, one after the other.
        """
        return _linear_operator(self.apply, self.adjoint, self.shape[:2], channel)

    def for_scene(self, scene: Scene) -> LightTransport:
        """The same matrix with its rows in the order of a scene's vertices.

        Parameters
        ----------
        scene : Scene
            The same geometry and materials; shapes may be merged or come in another order.

        Raises
        ------
        PrtError
            If the matrix belongs to another scene.
        """
        if isinstance(self.emission, StoredEmitters):
            return replace(self, emission=self.emission.of_scene(scene)).for_scene(scene)
        if self.measurement.kind != "vertices":
            check_scene(self.scene_hash, scene)
            return self
        known = mesh_vertices(scene)
        source = row_order(self.scene_hash, self.measurement.keys, scene)
        if source is None:
            return replace(self, measurement=known)
        rows, dense = self.reflection.rows_of(source), self.dense_vertices
        return replace(
            self,
            measurement=known,
            dense_vertices=None if dense is None else np.flatnonzero(np.isin(source, dense)),
            reflection=self.reflection.take(source),
            operators={name: operator.take(rows) for name, operator in self.operators.items()},
        )

    def with_bsdf(self, mesh: str, bsdf: mi.BSDF) -> LightTransport:
        """The transport with another BSDF on a glossy mesh; nothing is traced.

        Parameters
        ----------
        mesh : str
            Its name.
        bsdf : mi.BSDF

        Returns
        -------
        LightTransport
            Of the same points; rendered with the same scene. Light that this mesh sends to others remains that of the
            old BSDF, all that leaves it towards a camera is of the new one.

        Raises
        ------
        PrtError
            If the transport was not made with ``harmonics``, whose terms serve any BSDF, if there is no such glossy
            mesh, or if the BSDF cannot be factored or its diffuse part varies over the surface.
        """
        reflection = self.reflection
        if not isinstance(reflection, InOutFactors) or reflection.harmonics is None:
            raise PrtError(
                "these terms are of their own BRDFs; precompute them with harmonics=3 to choose later"
            )
        known = {m.name: m.vertices for m in self.meshes if reflection.material[m.vertices.start] >= 0}
        if mesh not in known:
            raise PrtError(f"{mesh!r} is no glossy mesh of this transport; it has: {', '.join(known)}")
        factors = harmonic_factors(bsdf, mesh, reflection.harmonics)
        if factors.varying_diffuse:
            raise PrtError(f"shape '{mesh}': the new BSDF has a texture; give one that is the same all over")
        material, albedo = reflection.material.copy(), reflection.albedo.copy()
        material[known[mesh]], albedo[known[mesh]] = len(reflection.factors), factors.diffuse
        new = replace(reflection, material=material, albedo=albedo, factors=(*reflection.factors, factors))
        return replace(self, reflection=new)

    def save(self, path: str | Path) -> None:
        """Write the matrix to one file, by convention ``*.prt``; nothing is left under the name if that fails.

        Raises
        ------
        PrtError
            If the folder does not exist or the file cannot be written (full disk, permissions).
        """
        write_store(path, *self.stored())

    def stored(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Attributes (JSON as it is) and arrays, as files have them (docs/file_format.md)."""
        attributes: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "emission": {"kind": self.emission.kind, **self.emission.attributes()},
            "basis": self.basis,
            "max_depth": self.max_depth,
            "measurement": self.measurement.attributes(),
            "reflection": {"kind": self.reflection.kind, **self.reflection.attributes()},
            "scene_hash": self.scene_hash,
            "report": self.report,
        }
        arrays = {f"measurement.{name}": array for name, array in self.measurement.arrays().items()}
        arrays |= {f"reflection.{name}": array for name, array in self.reflection.arrays().items()}
        if self.dense_vertices is not None:
            arrays["dense_vertices"] = self.dense_vertices.astype(np.uint32)
        kinds = dict[str, str]()
        for name, operator in self.operators.items():
            own_kinds, own = operator_arrays(operator, name)
            kinds, arrays = kinds | own_kinds, arrays | own
        return attributes | {"operators": kinds}, arrays


GlossyTransport = LightTransport  # one class serves both


@dataclass(frozen=True)
class TransposedTransport:
    """T transposed: from importance at points to directions ([Leh07] 2.6).

    Attributes
    ----------
    T : LightTransport
        Its transpose.
    """

    T: LightTransport

    @property
    def shape(self) -> tuple[int, int, int]:
        """(directions, points, 3)."""
        n, m, channels = self.T.shape
        return m, n, channels

    def apply(self, y: Floats) -> Floats:
        """(n, 3, k) to (n_directions, 3, k)."""
        return self.T.adjoint(y)

    def adjoint(self, x: Floats) -> Floats:
        """(n_directions, 3, k) to (n, 3, k)."""
        return self.T.apply(x)

    def as_linear_operator(self, channel: int | None = None) -> LinearOperator:
        """As that of ``LightTransport``, transposed."""
        return _linear_operator(self.apply, self.adjoint, self.shape[:2], channel)


def _linear_operator(apply: Any, adjoint: Any, shape: tuple[int, int], channel: int | None) -> LinearOperator:
    """SciPy's operator of products with (columns, 3, k) and (rows, 3, k)."""
    from scipy.sparse.linalg import LinearOperator

    if channel not in (None, 0, 1, 2):
        raise PrtError(f"channel {channel} is none of 0, 1, 2 (red, green, blue); leave it out for all three")
    own = slice(0, 3) if channel is None else slice(channel, channel + 1)
    blocks = own.stop - own.start

    def product(function: Any, length: int, x: NDArray[np.floating]) -> Floats:
        vectors = np.zeros((length, 3, x.size // (blocks * length)), np.float32)
        vectors[:, own] = np.moveaxis(x.reshape(blocks, length, -1), 0, 1)
        found = function(vectors)[:, own]
        return np.moveaxis(found, 1, 0).reshape(blocks * len(found), -1)

    n, m = shape
    return LinearOperator(
        (blocks * n, blocks * m),
        matvec=lambda x: product(apply, m, x)[:, 0],
        rmatvec=lambda y: product(adjoint, n, y)[:, 0],
        matmat=lambda x: product(apply, m, x),
        rmatmat=lambda y: product(adjoint, n, y),
        dtype=np.float32,
    )


def _blocks_of(emission: EmissionSpace, lights: Any, together: int) -> Iterator[tuple[int, Floats]]:
    """Lights (n_directions, 3, some), and the number of the first of these."""
    if not isinstance(lights, np.ndarray):
        remaining, first = iter(lights), 0
        while some := [emission.project(light) for light in islice(remaining, together)]:
            yield first, np.stack(some, axis=2)
            first += len(some)
        return
    if lights.ndim != 3 or lights.shape[:2] != (emission.size, 3):
        raise PrtError(
            f"lights of shape {lights.shape}: give ({emission.size}, 3, k), or one after the other"
        )
    for first in range(0, lights.shape[2], together):
        block = np.ascontiguousarray(lights[:, :, first : first + together], np.float32)
        if not np.isfinite(block).all():
            raise PrtError(f"lights from number {first} on have values that are NaN or infinite")
        yield first, block


def row_order(scene_hash: str, keys: NDArray[np.uint64], scene: Scene) -> NDArray[np.int64] | None:
    """Where a matrix has the vertices of a scene, (n_v,); None if they come in the same order.

    Raises
    ------
    PrtError
        If the matrix belongs to another scene.
    """
    check_scene(scene_hash, scene)
    wanted = vertex_points(scene).keys
    if np.array_equal(keys, wanted):
        return None
    ours, theirs = (np.argsort(k, kind="stable") for k in (keys, wanted))
    if not np.array_equal(keys[ours], wanted[theirs]):
        raise PrtError("this matrix belongs to other vertices of the same scene; precompute it again")
    source = np.empty_like(ours)
    source[theirs] = ours
    return source


def check_scene(scene_hash: str, scene: Scene) -> None:
    """Refuse a scene whose geometry or materials are others (PrtError)."""
    if scene.hash != scene_hash:
        raise PrtError(
            f"this matrix belongs to another scene than {scene.path or 'the one given'} "
            "(geometry or materials differ); precompute it again"
        )


def _checked(ids: ArrayLike, count: int, what: str) -> NDArray[np.int64]:
    """Ids as indices below ``count``; a mask of that length and negative ids mean what they do in NumPy."""
    chosen = np.atleast_1d(np.asarray(ids))
    if chosen.dtype == bool and chosen.shape == (count,):
        return np.flatnonzero(chosen)
    if chosen.ndim != 1 or not (chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)):
        raise PrtError(
            f"{what} ids must be a list of integers or a mask of {count}, not {chosen.dtype} of shape {chosen.shape}"
        )
    chosen = chosen.astype(np.int64)
    outside = (chosen < -count) | (chosen >= count)
    if outside.any():
        raise PrtError(f"{what} id {chosen[outside][0]} is out of range: there are {count}")
    return np.where(chosen < 0, chosen + count, chosen)
