"""Messages from the page over the socket of a view, as validated models (docs/api.md)."""

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, GetPydanticSchema, NonNegativeInt, TypeAdapter
from pydantic_core.core_schema import no_info_after_validator_function, str_schema

from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.inspect.maps.likelihood_map import MapOptions, Quantity
from beliefscope.inspect.maps.plane import Others

MAX_ANGLE = 1e3  # rad: beyond the turns of any door
READ_ONLY = "This server is read-only."

SceneLayer = Literal["replay", "objects", "estimates", "contours", "particles", "force", "map", "camera"]
LAYERS: tuple[SceneLayer, ...] = get_args(SceneLayer)
"""Layers of the 3D scene; each can be hidden."""

Viewpoint = Literal["first", "above", "camera"]
"""Initial viewpoint, above the belief, and facing the camera."""


FROM_TEXT = GetPydanticSchema(lambda *_: no_info_after_validator_function(Faults.parse, str_schema()))


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


class Cursor(_Message):
    """The page's selection and how it is displayed.

    Attributes:
        serial: counter of the page's cursors. data: name of the data set; empty for the task's first.
        faults: injected faults. scene: whether the 3D scene is updated, or only the maps.
        against: differences of the comparison run (``Selection.against``), whose estimate the scene shows; empty
            without one. comparison_maps: whether its maps are sent, too. quantity: of the maps; the other one if the
            filter does not have it. components: of the maps' axes; empty for those of the task's map. others: treatment
            of the components off the maps (``MapEngine.map``).
    """

    type: Literal["cursor"] = "cursor"
    serial: NonNegativeInt
    task: str
    filter: str
    episode: NonNegativeInt
    step: NonNegativeInt
    angle: Annotated[float, Field(ge=-MAX_ANGLE, le=MAX_ANGLE)] | None = None
    size: Literal[41, 135] = 41  # ``COARSE`` while the cursor moves, ``FINE`` when it rests
    faults: Annotated[Faults, FROM_TEXT] = NO_FAULTS
    scene: bool = True
    data: str = ""
    against: str = ""
    comparison_maps: bool = False
    quantity: Quantity = "likelihood"
    components: Annotated[tuple[str, ...], Field(strict=False, max_length=2)] = ()
    others: Others | None = None

    @property
    def map_options(self) -> MapOptions:
        """What the maps show."""
        return MapOptions(self.angle, self.quantity, self.components, self.others)


class SceneLayers(_Message):
    """Visible layers of a 3D scene and their appearance.

    Attributes:
        hidden: hidden layers. ground: map layer on the floor; ``fused`` if the maps do not have it.
        height: whether the map lies on the floor or under the belief, which is drawn above the object.
        tint: particles colored by weight, or by the share of each modality in it.
        scale, range, colours: as for the page's maps.
    """

    type: Literal["scene_layers"] = "scene_layers"
    hidden: Annotated[frozenset[SceneLayer], Field(strict=False)] = frozenset()
    ground: str = "fused"
    height: Literal["floor", "belief"] = "floor"
    tint: Literal["weight", "share"] = "weight"
    scale: Literal["normalised", "log"] = "normalised"
    range: Literal["own", "same"] = "own"
    colours: Literal["viridis", "cividis"] = "viridis"


class MoveViewpoint(_Message):
    """Move the viewpoint of the 3D scene."""

    type: Literal["viewpoint"] = "viewpoint"
    at: Viewpoint


class Theme(_Message):
    """The page's color theme."""

    type: Literal["theme"] = "theme"
    dark: bool = False


ViewMessage = Cursor | SceneLayers | MoveViewpoint | Theme
VIEW_MESSAGE: TypeAdapter[ViewMessage] = TypeAdapter(Annotated[ViewMessage, Field(discriminator="type")])


def describe_error(error: Any) -> str:
    """The first error of a failed validation, in one line: ``cursor.size: Input should be 41 or 135``.

    error: pydantic's ValidationError, or FastAPI's RequestValidationError.
    """
    first = error.errors()[0]
    message = first["msg"].removeprefix("Value error, ").rstrip(".")
    location = ".".join(str(part) for part in first["loc"])
    return f"{location}: {message}" if location else message


def close_reason(reason: str) -> str:
    """The reason cut to the 123 bytes that a WebSocket close frame can hold."""
    return reason.encode()[:123].decode(errors="ignore")
