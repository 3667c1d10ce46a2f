"""Command info: contents of a .twz file."""

from dataclasses import asdict
from typing import Any

import click

from terrainwave.arguments import count_of, crs_name
from terrainwave.cli.options import THREADS_OPTION, Input
from terrainwave.cli.output import (
    CommandWithoutTarget,
    plain,
    print_grid,
    print_json,
    print_table,
    reading,
    unit_behind,
)
from terrainwave.names import UNBOUNDED_MESHES


@click.command(cls=CommandWithoutTarget)
@click.argument("file", type=Input())
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
@click.option(
    "--errors",
    type=click.Choice(["measured", "recursive"]),
    help="List the largest error of each level: as stored, or by equations (2) and (3) of Yusov &"
    " Turlapov (2010) from the decoded heights, with that of its meshes (slow).",
)
@click.option("--voids", is_flag=True, help="Count voids (slow: decodes all heights).")
@click.option(
    "--parts",
    is_flag=True,
    help="List the bytes of each part, also of a URL, which takes many requests.",
)
@click.option(
    "--meshes",
    is_flag=True,
    help="List the triangles of each level, their bits and their zero trees (slow: makes all"
    " meshes).",
)
@click.option(
    "--stac",
    is_flag=True,
    help="Print an item for a STAC catalogue instead: outline, CRS, resolution, bound, checksum.",
)
@THREADS_OPTION
def info(file: str, as_json: bool, stac: bool, threads: int | None, **more: Any) -> None:
    """Show what FILE (.twz) contains."""
    import terrainwave

    with reading(file), terrainwave.open(file, threads=threads) as terrain:
        if stac:
            from terrainwave.globe.stac import stac_item

            print_json(stac_item(terrain), with_notes=False)
            return
        summary = terrain.info()
        found = _found(terrain, **more | {"parts": more["parts"] or "://" not in file})
    parts, errors, meshes = (found.get(name) for name in ("parts", "errors", "meshes"))
    if as_json:
        fields = {
            "parts": parts and asdict(parts),
            "level_errors": errors and errors.heights,
            "level_mesh_errors": errors and errors.meshes,
            "n_voids": found.get("n_voids"),
            "root": found["root"],
            "meshes": meshes and [level._asdict() for level in meshes],
        }
        known = {name: value for name, value in fields.items() if value is not None}
        print_json(summary.to_dict() | known)
        return
    print_table(_info_rows(summary, found))
    if parts is not None:
        _print_parts(parts)
    if errors is not None:
        _print_level_errors(summary.level_shapes, errors)
    if meshes is not None:
        _print_mesh_levels(meshes)


def _found(
    terrain: Any, *, errors: str | None, voids: bool, parts: bool, meshes: bool
) -> dict[str, Any]:
    """Return the results of options that were given; and the root of the digests, if any."""
    from terrainwave.mesh.level_errors import level_errors
    from terrainwave.mesh.statistics import mesh_levels

    found: dict[str, Any] = {"root": terrain.digest()}
    if parts:
        found["parts"] = terrain.parts()
    if errors is not None:
        found["errors"] = level_errors(terrain, errors)
    if voids:
        found["n_voids"] = terrain.count_voids()
    if meshes:
        found["meshes"] = mesh_levels(terrain)
    return found


def files_before(earlier: Any) -> str:
    return ", from ".join(
        f"{plain(file['file'])}, within {file['max_error']:.6g} of the original"
        for file in reversed(earlier)
    )


def _voids_in_words(info: Any, n_voids: int | None) -> str:
    if info.minimum is None:
        return "all samples"
    if not info.has_voids:
        return "none"
    kind = {
        "nodata": f"marked by the value {info.nodata}",
        "nan": "marked by NaN",
        "mask": "marked by a mask",
    }[info.voids]
    if n_voids is None:
        return kind
    return f"{count_of(n_voids, 'sample')}, {n_voids / (info.n_rows * info.n_cols):.4g} of all"


def _print_parts(parts: Any) -> None:
    rows = [("header and metadata", parts.metadata), ("tables", parts.tables)]
    rows += [("index", parts.index), ("heights", sum(parts.heights))]
    if len(parts.heights) > 1:
        rows += [(f"  level {level}", size) for level, size in enumerate(parts.heights)]
    rows += [("meshes", parts.meshes), ("digests", parts.digests)]
    total = sum(size for name, size in rows if not name.startswith(" "))
    print_grid(
        ["part", "bytes", "share"],
        [[name, f"{size:,}", f"{100 * size / total:.3g} %"] for name, size in rows],
    )


def _print_mesh_levels(levels: Any) -> None:
    rows = [
        [
            str(found.level),
            f"{found.n_triangles:,}",
            f"{found.label_bits:.3f}",
            "" if found.significant is None else f"{100 * found.significant:.3g} %",
            "" if found.n_loose is None else f"{found.n_loose:,}",
        ]
        for found in levels
    ]
    print_grid(["level", "triangles", "bits/sample", "significant nodes", "loose triangles"], rows)


def _print_level_errors(shapes: Any, errors: Any) -> None:
    columns = [errors.heights] if errors.meshes is None else [errors.heights, errors.meshes]
    rows = [
        [str(level), *map(str, shape), *(f"{error:.6g}" for error in of_level)]
        for level, (shape, *of_level) in enumerate(zip(shapes, *columns, strict=True))
    ]
    heads = ["level", "rows", "columns", "largest error", "of meshes"]
    print_grid(heads[: 3 + len(columns)], rows)


def _info_rows(info: Any, found: dict[str, Any]) -> list[tuple[str, object]]:
    unit = unit_behind(info.units)
    crs = crs_name(info.crs)
    if crs != info.crs and info.crs:
        crs += " (WKT; --json shows all)"
    levels = ", ".join(f"{rows} x {cols}" for rows, cols in info.level_shapes)
    extent = "none" if info.minimum is None else f"{info.minimum:.6g} to {info.maximum:.6g}{unit}"
    scale = f"{info.scale:g}, offset {info.offset:g}"
    way = "faithful to its paper" if info.faithful else f"effort {info.effort}"
    tolerance = f"within {info.mesh_tolerance:.6g}{unit} of the heights"
    if info.mesh != "none" and not info.measured_meshes:
        tolerance += "; errors not measured"
    if info.mesh in UNBOUNDED_MESHES:
        tolerance = f"coefficients above {info.mesh_tolerance:.6g}{unit}; errors are measured"
    floats = (
        f"; stored floats may differ by {info.float_error:.3g} more" if info.float_error else ""
    )
    rows = [
        ("file", f"{info.path}, {info.n_bytes:,} bytes"),
        ("size", f"{info.n_rows} rows x {info.n_cols} columns, {info.dtype}"),
        ("bits/sample", f"{info.bits_per_sample:.4g}, {info.ratio:.4g} times smaller than raw"),
        (
            "max error",
            f"asked {info.max_error:.6g}, holds {info.effective_error:.6g}{unit}{floats}"
            + _SIDES[info.bound],
        ),
        ("proof", "" if info.proved else "none (made with --no-verify; `verify` compares heights)"),
        (
            "moved",
            f"{info.moved_error:.6g}{unit} of it from an earlier file" if info.moved_error else "",
        ),
        ("made from", files_before(info.earlier)),
        ("quantum", f"{info.quantum:.6g}{unit}"),
        ("heights", extent + _MEANINGS[info.heights_are]),
        ("unit", _unit_in_words(info)),
        ("voids", _voids_in_words(info, found.get("n_voids"))),
        ("method", f"{info.method}, {way}, border rings {info.border_rings}"),
        ("block", f"{info.block} x {info.block} cells"),
        ("mesh", info.mesh if info.mesh == "none" else f"{info.mesh}, {tolerance}"),
        ("root of heights", found["root"] or ""),
        ("levels", f"{info.n_levels}: {levels}"),
        ("nodata", "none" if info.nodata is None else info.nodata),
        ("CRS", crs),
        ("epoch", "" if info.coordinate_epoch is None else f"{info.coordinate_epoch:.10g}"),
        ("bounds", ", ".join(f"{value:.10g}" for value in info.bounds)),
        ("pixel", f"{info.transform[0]:.10g}, {info.transform[4]:.10g}"),
        ("a pixel is", (info.area_or_point or "").lower()),
        ("scale", scale if (info.scale, info.offset) != (1, 0) else ""),
        ("description", info.description or ""),
        *((f"tag {name}", value) for name, value in info.tags.items()),
        *((f"band tag {name}", value) for name, value in info.band_tags.items()),
        ("colour", info.color_interpretation or ""),
    ]
    return [(name, value) for name, value in rows if value != ""]


_SIDES = {
    "both": "",
    "above": "; no height is below its original",
    "below": "; no height is above its original",
}
_MEANINGS = {
    "height": "",
    "depth": " (depths: they go down)",
    "radius": " (radii: from the centre of the body)",
}


def _unit_in_words(info: Any) -> str:
    if info.units is None:
        return "unknown"
    if info.units_of_crs is not None:
        return f"{info.units} (from the band; the CRS says {info.units_of_crs})"
    return f"{info.units} (from the {info.units_from})"
