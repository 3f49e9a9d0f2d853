"""Configurations in YAML: of one survey, and of an estate whose surveys come night after night."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, model_validator

from vinemap import naming
from vinemap.config.names import Name, ParcelName, check_parcel
from vinemap.config.settings import Options, Settings
from vinemap.config.yaml_files import checked_by, merge, nearest, read_yaml, validated
from vinemap.errors import ConfigError
from vinemap.geo.crs import parse_crs
from vinemap.geo.main import Origin, check_origin

FILES = ("cloud", "boundaries", "rows", "vines", "row_register")
"""Keys of files, which in a survey's own file are named from its folder on."""
MainOrigin = Annotated[Origin, checked_by(check_origin)]


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
    rows: Path | None = Field(None, description="known rows: lines, or posts of one name; none: rows are sought")
    rows_crs: Annotated[str, checked_by(parse_crs)] | None = Field(
        None, description="CRS of the known rows and vines, as EPSG:n, where their file states none"
    )
    vines: Path | None = Field(None, description="known vines: points, one each; none: where they stand is estimated")
    row_register: Path | None = Field(
        None, description="register of known rows; none: data/register.gpkg, where that is there"
    )
    parcels: list[ParcelName] | None = Field(
        None, min_length=1, description="names of the parcels; none: all that there are"
    )
    crs: Annotated[str, checked_by(parse_crs)] | None = Field(
        None, description="CRS of the cloud, as EPSG:n, where the file states none or a wrong one"
    )
    origin: MainOrigin | None = Field(None, description="origin of {Main}: latitude, longitude (degrees), altitude (m)")
    settings: Settings = Settings()
    job: JobOptions = JobOptions()
    overrides: dict[ParcelName, ParcelConfig] = Field({}, description="what is otherwise in a parcel, by its name")

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
                raise ValueError(f"overrides has {name!r}, which isn't among parcels: {nearest(name, self.parcels)}")
        return self

    def all_settings(self) -> list[Settings]:
        """Settings for all parcels, and those for single ones."""
        return [self.settings, *(own.settings for own in self.overrides.values())]

    def of_parcel(self, name: str) -> ParcelConfig:
        """What holds for a parcel."""
        return self.overrides.get(name) or ParcelConfig(origin=self.origin, settings=self.settings)


class SurveyConfig(_Surveys):
    """A survey: its cloud, its parcels and the settings for all of them."""

    survey: Name = Field(
        examples=["survey"],
        description="name, and where its data lie: data/surveys/<survey>; not needed in a survey.yaml there",
    )
    cloud: Path | list[Path] | None = Field(
        None,
        description="file or address of a cloud, folder of such, or a list of both, worked as one; "
        "data/surveys/<survey>/<survey>.laz by default",
    )
    simulate: Literal["barolo"] | None = Field(None, description="example to simulate where the cloud is missing")
    _shared: set[str] = PrivateAttr(default_factory=set)

    @model_validator(mode="after")
    def _example(self) -> SurveyConfig:
        if self.simulate and (self.simulate != self.survey or self.cloud):
            raise ValueError(f"simulate ({self.simulate}) must be the survey's own name, and cloud be left out")
        return self

    def own_overrides(self) -> set[str]:
        """Names for which the survey itself says what is otherwise, not the estate for whichever survey has them."""
        return self.overrides.keys() - self._shared


class EstateConfig(_Surveys):
    """An estate: the folder its surveys come into, and what holds for all of them."""

    surveys: Path = Field(Path("data/surveys"), description="folder in which surveys arrive")
    products: Path = Field(Path("data/products"), description="folder of the products")
    settle: float = Field(
        300, ge=0, le=1_000_000, description="seconds for which the files of a survey must have stayed as they are"
    )
    cron: str = Field("0 2 * * *", description="when vinemap nightly runs: minute, hour, day, month, weekday")
    timezone: str = Field("UTC", description="time zone of that, as Europe/Rome")
    _given: dict[str, Any] = PrivateAttr(default_factory=dict)

    def of_survey(self, name: str, own: Path | None, **files: Path | list[Path] | None) -> SurveyConfig:
        """What holds for a survey with the ``files`` that were found, whose ``own`` file may state otherwise.

        Raises
        ------
        ConfigError
            As :func:`load_survey`.
        """
        common = {key: value for key, value in self._given.items() if key in _Surveys.model_fields}
        stated = read_yaml(own) if own else {}
        if not isinstance(stated, dict):
            raise ConfigError(f"{own}: holds no keys: write it like the estate's own file")
        if own:
            _place(stated, own.parent)
        parcels, overrides = stated.get("parcels"), common.get("overrides")
        if parcels and isinstance(parcels, list) and isinstance(overrides, dict):
            names = {naming.composed(str(parcel)) for parcel in parcels}
            common["overrides"] = {key: own for key, own in overrides.items() if naming.composed(str(key)) in names}
        found = {key: file for key, file in files.items() if file}
        config = validated(SurveyConfig, merge(common | found, stated) | {"survey": name}, own)
        config._shared.update(self.overrides.keys())  # noqa: SLF001
        return config


def _place(stated: dict[str, Any], folder: Path) -> None:
    """Let files that a survey's own file names be named from its folder on; addresses stay, and null names none."""
    for key in [key for key in FILES if key in stated]:
        if stated[key] is None:
            del stated[key]
        elif stated[key]:
            stated[key] = _beside(folder, stated[key])
    overrides = stated.get("overrides")
    for part in (stated, *(overrides.values() if isinstance(overrides, dict) else ())):
        match part:
            case {"settings": {"ground": {"pipeline": str(named)} as ground}}:
                ground["pipeline"] = _beside(folder, named)


def _beside(folder: Path, named: Any) -> Any:
    if isinstance(named, list):
        return [_beside(folder, one) for one in named]
    return named if naming.url_of(Path(str(named))) else folder / str(named)


def choose_parcel(config: SurveyConfig, name: str) -> str:
    """Return the parcel's name if the configuration knows it, or leaves the parcels' names to the boundaries.

    Raises
    ------
    ConfigError
        If it doesn't; names the nearest that it does.
    """
    name = check_parcel(name)
    if config.parcels is None or name in config.parcels:
        return name
    raise ConfigError(f"survey {config.survey} has no parcel {name!r}: {nearest(name, config.parcels)}")


def load_survey(path: Path) -> SurveyConfig:
    """Read a survey's YAML file; ConfigError names the key, its value and what it may be."""
    return validated(SurveyConfig, read_yaml(path), path)


def survey_config(**options: Any) -> SurveyConfig:
    """Configuration of a survey without a file; ConfigError as of :func:`load_survey`."""
    return validated(SurveyConfig, {key: value for key, value in options.items() if value is not None}, None)


def load_estate(path: Path) -> EstateConfig:
    """Read an estate's YAML file; ConfigError names the key, its value and what it may be."""
    data = read_yaml(path)
    config = validated(EstateConfig, data, path)
    config._given.update(data)  # noqa: SLF001
    return config


def load_settings(path: Path) -> Settings:
    """Read a YAML file with settings of stages, under ``settings`` as in a survey's or without.

    Raises
    ------
    ConfigError
        That names the key, its value and what it may be.
    """
    data = read_yaml(path)
    if isinstance(data, dict) and set(data) == {"settings"}:
        data = merge({}, data["settings"])
    return validated(Settings, data, path)
