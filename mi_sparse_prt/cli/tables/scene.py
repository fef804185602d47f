"""What a scene consists of."""

from __future__ import annotations

from typing import Any

from rich.table import Table

import mi_sparse_prt as prt
from mi_sparse_prt.cli.tables.layout import FACTS, byte_count, new_table, sentences_tables


def scene_report(scene: prt.Scene) -> dict[str, Any]:
    """A scene's facts, JSON as it is."""
    return {
        "path": scene.path,
        "hash": scene.hash,
        "vertices": len(scene.positions),
        "meshes": {
            mesh.name: {
                "vertices": mesh.vertices.stop - mesh.vertices.start,
                "triangles": len(mesh.triangles),
            }
            for mesh in scene.meshes
        },
        "box": [scene.positions.min(axis=0).tolist(), scene.positions.max(axis=0).tolist()],
        "grey": scene.grey,
        "diffuse": scene.diffuse,
        "warnings": scene.warnings,
    }


def scene_tables(scene: prt.Scene) -> list[Table]:
    """What a scene consists of, and what its matrix would take."""
    report = scene_report(scene)
    meshes = []
    for mesh in scene.meshes:
        sizes = report["meshes"][mesh.name]
        albedo = " ".join(f"{value:.3f}" for value in scene.albedo[mesh.vertices].mean(axis=0))
        meshes.append((mesh.name, f"{sizes['vertices']:,}", f"{sizes['triangles']:,}", albedo))
    corners = ("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in report["box"])
    facts = [
        ("box", " to ".join(corners)),
        ("grey, so one channel of indirect light", "yes" if scene.grey else "no"),
        ("diffuse only", "yes" if scene.diffuse else "no"),
        ("direct matrix, 6 x 32 x 32 directions", byte_count(report["vertices"] * 6144 // 8)),
        ("hash", scene.hash),
    ]
    title = f"{scene.path}: {report['vertices']:,} vertices"
    return [
        new_table(title, ("mesh", "vertices", "triangles", "mean albedo"), meshes),
        new_table("Scene", FACTS, facts),
        *sentences_tables("Warnings", scene.warnings),
    ]
