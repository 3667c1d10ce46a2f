"""`Explorer`: the map of a terrain in a notebook, with its state."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import anywidget
import traitlets

from terrainwave.arguments import checked_number, checked_whole, shown
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.ext.html import terrain_html
from terrainwave.ext.notebook.channel import Answer, Channel, Question, read_ranges
from terrainwave.ext.notebook.drawn import outline, region_of_box
from terrainwave.ext.notebook.page_files import page_files, page_version, widget_module
from terrainwave.ext.serve.catalog import describe
from terrainwave.file import TerrainFile
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.polynomials import fit_places
from terrainwave.grid.quadtree import Region
from terrainwave.place.system import need_pyproj

# Fields of a camera, and the range of each number, as in the page's address.
_CAMERA = {
    "lon": (-540, 540), "lat": (-90, 90), "zoom": (0, 24), "pitch": (0, 80), "bearing": (-360, 360),
}  # fmt: skip
LEAST_HEIGHT, MOST_HEIGHT = 100, 10_000


class Explorer(anywidget.AnyWidget):
    """A map of a terrain in 3-D; made by `Terrain.explore`.

    Attributes
    ----------
    camera : dict, optional
        ``lon``, ``lat`` in degrees, ``zoom``, ``pitch``, ``bearing`` as in the map; None until it
        is shown. Setting it moves the map.
    window : Region, optional
        Area drawn on the map: ``(row, col, n_rows, n_cols)`` of the full grid, for
        ``terrain.read(window=...)``; None if nothing is drawn. Setting it draws it.
    height : int
        Pixels; the width is that of the cell.
    """

    _esm = widget_module()
    _page = traitlets.Unicode().tag(sync=True)
    _window = traitlets.Any(None).tag(sync=True)
    camera = traitlets.Any(None).tag(sync=True)
    window = traitlets.Any(None)
    height = traitlets.Int(480, min=LEAST_HEIGHT, max=MOST_HEIGHT).tag(sync=True)

    def __init__(self, globe: Globe, described: dict[str, Any], **traits: Any) -> None:
        self.terrain = globe.terrain
        source = self.terrain.container.source
        self._globe = globe
        self._channel = Channel(
            self.send,
            in_threads={
                "page": lambda _: Answer({"names": [*page_files()]}, [*page_files().values()]),
                "terrain": lambda _: Answer({"terrain": described, "size": source.size}, []),
                "ranges": lambda question: read_ranges(source, question),
            },
            at_once={"draw": self._answer_draw},
        )
        super().__init__(_page=page_version(), **traits)
        self.on_msg(lambda _, content, __: self._channel.take(content))

    def close(self) -> None:
        """Remove the map from the notebook; the terrain stays open."""
        self._channel.close()
        super().close()

    def _answer_draw(self, question: Question) -> Answer:
        box = question.get("box")
        self.window = None if box is None else region_of_box(self._globe, box)
        return Answer({}, [])

    @traitlets.validate("camera")
    def _check_camera(self, proposal: Any) -> dict[str, float] | None:
        given = proposal["value"]
        if given is None:
            return None
        if not isinstance(given, Mapping) or set(given) != set(_CAMERA):
            raise _RefusedTraitError(
                f"found `camera` {shown(given)}, expected a dict of {', '.join(_CAMERA)}"
            )
        with _refusing():
            return {
                name: checked_number(name, given[name], least=least, most=most)
                for name, (least, most) in _CAMERA.items()
            }

    @traitlets.validate("window")
    def _check_window(self, proposal: Any) -> Region | None:
        given = proposal["value"]
        with _refusing():
            return None if given is None else self.terrain.region(given)

    @traitlets.observe("window")
    def _show_window(self, change: Any) -> None:
        region: Region | None = change["new"]
        self._window = (
            None if region is None
            else {**region._asdict(), "outline": outline(self._globe, region)}
        )  # fmt: skip

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        """Return the widget and, for notebooks without widgets, the picture of the terrain."""
        data, metadata = super()._repr_mimebundle_(**kwargs) or ({}, {})
        still = {"text/plain": repr(self), "text/html": terrain_html(self.terrain)}
        return data | still, metadata

    def __repr__(self) -> str:
        return f"<Explorer of {self.terrain!r}>"


class _RefusedTraitError(InvalidArgumentError, traitlets.TraitError):
    """Invalid value of a trait: traitlets restores the old value, also for the page."""


@contextmanager
def _refusing() -> Iterator[None]:
    try:
        yield
    except InvalidArgumentError as error:
        raise _RefusedTraitError(*error.args) from None


def explorer_of(
    terrain: TerrainFile, *, camera: Any, height: int, radius: float | None
) -> Explorer:
    """Return the map of a terrain; see `Terrain.explore`."""
    height = checked_whole("height", height, least=LEAST_HEIGHT, most=MOST_HEIGHT)
    if radius is not None:
        radius = checked_number("radius", radius, above=0)
    need_pyproj(extra="notebook", purpose="explore")
    try:
        globe = Globe(terrain, radius=radius)
        places = fit_places(globe)
    except InvalidHeightsError as error:
        raise InvalidHeightsError(f"{error}; terrain.view() shows it") from error
    # The first encoding of the page's tiles that holds all heights, else the usual one.
    holding = [one for one in tiling.ENCODINGS if tiling.note_on_range(globe, one) is None]
    described = describe("terrain", globe, [*holding, tiling.MAPBOX][0])
    described["placed"] = places.as_json(globe)
    return Explorer(globe, described, camera=camera, height=height)
