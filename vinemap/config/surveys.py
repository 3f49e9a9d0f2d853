"""Configurations in YAML: of one survey, and of an estate whose surveys come night after night."""

from __future__ import annotations

import difflib
import re
import reprlib
import unicodedata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

import yaml
from pydantic import AfterValidator, Field, PrivateAttr, ValidationError, model_validator

from vinemap.config.camera import Camera
from vinemap.config.settings import OdometryOptions, Options, Settings
from vinemap.errors import ConfigError, InputError
from vinemap.geo.crs import Origin, Start, check_origin, check_start, parse_crs
from vinemap.paths import LONGEST_NAME, MOST_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable

    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=Options)
T = TypeVar("T")

FORBIDDEN = re.compile(r'[/\\:*?"<>|!\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]|%[0-9a-fA-F]{2}')
"""What a name of a file can't have on one system or another; pyogrio cuts it at "!", QGIS takes %20 for a space."""
DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for itself."""
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 80


def check_name(name: str) -> str:
    """Return the name of a parcel or survey, its Unicode composed, if it can be the name of a file.

    Raises
    ------
    ConfigError
        If it is empty, too long, or has characters of paths.
    """
    name = unicodedata.normalize("NFC", name)
    if (
        not 0 < len(name) <= LONGEST_NAME
        or FORBIDDEN.search(name)
        or DEVICES.fullmatch(name)
        or name[0] in ".- "
        or name[-1] in ". "
        or len(name.encode()) > MOST_BYTES
    ):
        raise ConfigError(f"name {name!r} can't name a file: use letters, digits, spaces, '-' and '_', a letter first")
    return name


def _checked(check: Callable[[T], Any]) -> AfterValidator:
    """A check that raises errors of ours, for pydantic."""

    def checked(value: T) -> T:
        try:
            check(value)
        except (ConfigError, InputError) as error:
            raise ValueError(str(error)) from error
        return value

    return AfterValidator(checked)


Name = Annotated[str, AfterValidator(lambda name: unicodedata.normalize("NFC", name)), _checked(check_name)]
MainOrigin = Annotated[Origin, _checked(check_origin)]
MapStart = Annotated[Start, _checked(check_start)]


class JobOptions(Options):
    """How the parcels of a survey are worked."""

    engine: Literal["processes", "dask"] = Field("processes", description="processes here, or a Dask cluster's workers")
    scheduler: str | None = Field(None, description="address of the Dask scheduler, as tcp://host:8786")
    workers: int | None = Field(
        None, ge=1, le=10_000, description="parcels worked at once; none: as cores and memory allow"
    )
    limit: float = Field(3600, gt=0, le=1_000_000, description="seconds that a parcel may take")
    memory: float | None = Field(
        None, ge=0.5, le=100_000, description="memory that a parcel may take (GB); none: its share of what there is"
    )

    @model_validator(mode="after")
    def _reachable(self) -> JobOptions:
        if (self.engine == "dask") != (self.scheduler is not None):
            raise ValueError("engine dask and the address of a scheduler go together")
        return self


class ParcelConfig(Options):
    """What is otherwise in one parcel."""

    origin: MainOrigin | None = Field(None, description="origin of {Main}: latitude, longitude (degrees), altitude (m)")
    settings: Settings = Settings()


class _Surveys(Options):
    """What is the same for a survey and an estate."""

    boundaries: Path | None = Field(None, description="polygons of the parcels, named in one of their columns")
    parcels: list[Name] | None = Field(None, min_length=1, description="names of the parcels; none: all that there are")
    crs: Annotated[str, _checked(parse_crs)] | None = Field(
        None, description="CRS of the cloud, as EPSG:n, where the file states none or a wrong one"
    )
    origin: MainOrigin | None = Field(None, description="origin of {Main}: latitude, longitude (degrees), altitude (m)")
    settings: Settings = Settings()
    job: JobOptions = JobOptions()
    overrides: dict[Name, ParcelConfig] = Field({}, description="what is otherwise in a parcel, by its name")

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, data: Any) -> Any:
        """Give the settings of single parcels what they leave open."""
        if not isinstance(data, dict) or not isinstance(overrides := data.get("overrides"), dict):
            return data
        common = {key: data[key] for key in ("origin", "settings") if key in data}
        return data | {"overrides": {name: merge(common, own) for name, own in overrides.items()}}

    @model_validator(mode="after")
    def _known(self) -> _Surveys:
        for name in self.overrides:
            if self.parcels and name not in self.parcels:
                raise ValueError(f"overrides has {name!r}, which isn't among parcels: {_nearest(name, self.parcels)}")
        return self

    def of_parcel(self, name: str) -> ParcelConfig:
        """What holds for a parcel."""
        return self.overrides.get(name) or ParcelConfig(origin=self.origin, settings=self.settings)


class SurveyConfig(_Surveys):
    """A survey: its cloud, its parcels and the settings for all of them."""

    survey: Name = Field(description="name; its data lie in data/surveys/<survey>")
    cloud: Path | None = Field(None, description="LAS, LAZ or COPC file; data/surveys/<survey>/<survey>.laz by default")
    simulate: Literal["barolo"] | None = Field(None, description="example to simulate where the cloud is missing")

    @model_validator(mode="after")
    def _example(self) -> SurveyConfig:
        if self.simulate and (self.simulate != self.survey or self.cloud):
            raise ValueError(f"simulate ({self.simulate}) must be the survey's own name, and cloud be left out")
        return self


class EstateConfig(_Surveys):
    """An estate: the folder its surveys come into, and what holds for all of them."""

    surveys: Path = Field(Path("data/surveys"), description="folder in which surveys arrive")
    products: Path = Field(Path("data/products"), description="folder of the products")
    settle: float = Field(
        300, ge=0, le=1_000_000, description="seconds for which the files of a survey must have stayed as they are"
    )
    cron: str = Field("0 2 * * *", description="when make nightly runs: minute, hour, day, month, weekday")
    timezone: str = Field("UTC", description="time zone of that, as Europe/Rome")
    _given: dict[str, Any] = PrivateAttr(default_factory=dict)

    def of_survey(self, name: str, own: Path | None, **files: Path | None) -> SurveyConfig:
        """What holds for a survey with the ``files`` that were found, whose ``own`` file may state otherwise.

        Raises
        ------
        ConfigError
            As :func:`load_survey`.
        """
        common = {key: value for key, value in self._given.items() if key in _Surveys.model_fields}
        stated = _read_yaml(own) if own else {}
        if not isinstance(stated, dict):
            raise ConfigError(f"{own}: holds no keys: write it like the estate's own file")
        if own:
            stated |= {key: own.parent / str(stated[key]) for key in ("cloud", "boundaries") if stated.get(key)}
        parcels, overrides = stated.get("parcels"), common.get("overrides")
        if parcels and isinstance(parcels, list) and isinstance(overrides, dict):
            composed = {unicodedata.normalize("NFC", str(parcel)) for parcel in parcels}
            common["overrides"] = {
                key: own for key, own in overrides.items() if unicodedata.normalize("NFC", str(key)) in composed
            }
        return _validated(SurveyConfig, merge(merge(common, files), stated) | {"survey": name}, own)


class DriveConfig(Options):
    """One drive of a robot."""

    frames: list[Path] = Field(min_length=1, description="images, folders of images, or videos, in order")
    start: MapStart | None = Field(None, description="latitude, longitude, heading clockwise from north (degrees)")


class DrivesConfig(Options):
    """Drives of a robot whose tracks are made in one job."""

    camera: Path = Field(description="file of the robot's camera")
    rows: Path | None = Field(None, description="vine rows, for the distance to the nearest one")
    out: Path = Field(Path("data/tracks"), description="folder of the tracks")
    odometry: OdometryOptions = OdometryOptions()
    drives: dict[Name, DriveConfig] = Field(min_length=1, description="the drives by their names")


def merge(common: Any, own: Any) -> Any:
    """Options with others laid over them, key by key."""
    if isinstance(common, dict) and isinstance(own, dict) and common is not own:
        return common | {key: merge(common.get(key), value) for key, value in own.items()}
    return common if own is None else own


def choose_parcel(config: SurveyConfig, name: str) -> str:
    """Return the parcel's name if the configuration knows it, or leaves the parcels' names to the boundaries.

    Raises
    ------
    ConfigError
        If it doesn't; names the nearest that it does.
    """
    name = check_name(name)
    if config.parcels is None or name in config.parcels:
        return name
    raise ConfigError(f"survey {config.survey} has no parcel {name!r}: {_nearest(name, config.parcels)}")


def _nearest(word: str, known: list[str]) -> str:
    lower = {k.lower(): k for k in known}
    close = difflib.get_close_matches(word.lower(), list(lower), n=1, cutoff=0.5)
    return f"did you mean {lower[close[0]]!r}?" if close else f"known are {', '.join(known)}"


def load_survey(path: Path) -> SurveyConfig:
    """Read a survey's YAML file; ConfigError names the key, its value and what it may be."""
    return _validated(SurveyConfig, _read_yaml(path), path)


def load_drives(path: Path) -> DrivesConfig:
    """Read the YAML file of a robot's drives; ConfigError names the key, its value and what it may be."""
    return _validated(DrivesConfig, _read_yaml(path), path)


def survey_config(**options: Any) -> SurveyConfig:
    """Configuration of a survey without a file; ConfigError as of :func:`load_survey`."""
    return _validated(SurveyConfig, {key: value for key, value in options.items() if value is not None}, None)


def load_estate(path: Path) -> EstateConfig:
    """Read an estate's YAML file; ConfigError names the key, its value and what it may be."""
    data = _read_yaml(path)
    config = _validated(EstateConfig, data, path)
    config._given.update(data)  # noqa: SLF001
    return config


def load_settings(path: Path) -> Settings:
    """Read a YAML file with settings of stages, under ``settings`` as in a survey's or without.

    Raises
    ------
    ConfigError
        That names the key, its value and what it may be.
    """
    data = _read_yaml(path)
    return _validated(
        Settings, data["settings"] if isinstance(data, dict) and set(data) == {"settings"} else data, path
    )


def load_camera(path: Path) -> Camera:
    """Read the YAML file of a robot's camera; ConfigError names the key, its value and what it may be."""
    return _validated(Camera, _read_yaml(path), path)


class _Loader(yaml.SafeLoader):
    """YAML in which a date is a word and no key stands twice."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise yaml.constructor.ConstructorError(
                problem=f"{', '.join(twice)} stands there twice", problem_mark=node.start_mark
            )
        return super().construct_mapping(node, deep)


def _read_yaml(path: Path) -> Any:
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506 - a SafeLoader
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        folder = path.parent if path.parent.is_dir() else Path()
        known = [str(p) for p in sorted(folder.glob("*.yaml"))]
        hint = f": {_nearest(str(path), known)}" if known else ""
        raise ConfigError(f"{path}: no such file{hint}") from error
    except OSError as error:
        raise ConfigError(f"{path}: can't be read ({error.strerror})") from error
    except Exception as error:  # a YAMLError, or others of tags in odd places
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: no valid YAML ({reason})") from error
    return {} if data is None else data


def _validated(model: type[M], data: Any, path: Path | None) -> M:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # A parcel that inherits what is wrong for all needn't say so once more.
        reasons = dict.fromkeys(_explain(e, model) for e in _own(error.errors()))
        raise ConfigError(f"{path or 'survey'}: {'; '.join(reasons)}") from error


def _own(errors: list[ErrorDetails]) -> list[ErrorDetails]:
    known = [(error, _short.repr(error["input"])) for error in errors]
    common = {(error["loc"], value) for error, value in known}
    return [e for e, value in known if e["loc"][:1] != ("overrides",) or (e["loc"][2:], value) not in common]


def _explain(error: ErrorDetails, model: type[Options]) -> str:
    place = ".".join(str(part) for part in error["loc"]) or "the file"
    if error["type"] == "extra_forbidden":
        keys = list(_model_at(model, error["loc"][:-1]).model_fields)
        return f"unknown key {place}: {_nearest(str(error['loc'][-1]), keys)}"
    if error["type"] == "missing":
        return f"{place} is missing"
    message = error["msg"].removeprefix("Value error, ")
    value = _short.repr(error["input"])
    a_word = error["type"] == "string_type" and isinstance(error["input"], (bool, int, float))
    hint = ": put it in quotes" if a_word else ""
    return f"{place} = {value if len(value) < 80 else value[:80] + '…'}: {message[0].lower()}{message[1:]}{hint}"


def _model_at(model: type[Options], loc: tuple[int | str, ...]) -> type[Options]:
    for part in loc:
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        candidates = [annotation, *get_args(annotation)]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, Options)), model)
    return model
