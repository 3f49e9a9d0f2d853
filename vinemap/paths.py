"""Names of files: the only place where one is written."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from uuid import uuid4

from vinemap.naming import plain, safe, url_of

if TYPE_CHECKING:
    from collections.abc import Sequence

DATA = Path("data")
EPT = "ept.json"
"""File that tells of Entwine Point Tiles, in their folder."""
PIECES = ".pieces-"
"""How the name of a folder begins that holds the points of a survey's parcels while it is worked."""
RUN = "run.json"
INDEX = "index.html"
SURVEYS, PRODUCTS = DATA / "surveys", DATA / "products"
"""Folders of surveys and of what is made of them, where nobody says otherwise."""
ESTATE = Path("configs/nightly.yaml")
"""Configuration of the estate whose surveys come night after night."""
REGISTER = DATA / "register.gpkg"
"""Register of the estate's rows, where nobody names another."""
OWN_CONFIGURATION = "survey.yaml"
"""File in a survey's folder that says what is otherwise in it."""
EXPORTS = Path("exports")
"""Folder of what is exported from products, apart from them, where nobody says otherwise."""
TRACK = Path("track.gpkg")
"""Track of a robot, where nobody says otherwise."""
QGIS_PROJECT = "project.qgs"
"""The project in a ``.qgz``."""
PLUGIN, PLUGIN_ZIP = Path(__file__).parent / "plugin" / "qgis", Path("vinemap_qgis.zip")
"""Files of the QGIS plugin, and what they are packed into where nobody says otherwise."""
PLUGIN_ABOUT, PLUGIN_COMMAND = "metadata.txt", "command.txt"
"""Files of it that tell QGIS what it is, and it where vinemap is."""
MATERIALS, MODEL, MODEL_CONFIG = "vineyard.mtl", "model.sdf", "model.config"
"""Files of a model of Gazebo."""
EXAMPLE = Path("configs/barolo.yaml")
"""Configuration of the example."""
WEB = Path(__file__).parent / "product" / "pages" / "web"
PAGE_STYLE, PAGE_LICENCES = WEB / "dist" / "style.css", WEB / "dist" / "LICENSES.txt"
"""Style of pages, and the licences of what they bundle."""


def _packed(path: Path) -> Path:
    """A file of the repository, which lies within the package where that is installed."""
    package = Path(__file__).parent
    return next((there for folder in (package, package.parent) if (there := folder / path).is_file()), path)


TABLE_2_1, PACKED_EXAMPLE = _packed(DATA / "table_2_1.csv"), _packed(EXAMPLE)
"""The thesis's table of rows, and the example's configuration as it comes with the package."""


def bare(cloud: Path) -> str:
    """Name of a cloud without what tells its format (``.laz``, ``.copc.laz``); EPT is called as its folder."""
    if cloud.name == EPT:
        return cloud.absolute().parent.name
    name = Path(urlsplit(url).path) if (url := url_of(cloud)) else cloud
    return re.sub(r"\.copc$", "", name.stem, flags=re.IGNORECASE)


def stem(cloud: Path) -> str:
    """Name of a cloud without what tells its format, fit to name other files."""
    return plain(bare(cloud))


def named_by(clouds: Sequence[Path]) -> str:
    """What a survey is called after its files: a single one, or the folder that holds them all."""
    folders = {cloud.resolve().parent.parent if cloud.name == EPT else cloud.resolve().parent for cloud in clouds}
    return stem(clouds[0]) if len(clouds) == 1 or len(folders) > 1 else plain(folders.pop().name)


def configuration(survey: str) -> Path:
    """Configuration of a survey."""
    return Path("configs") / f"{survey}.yaml"


def survey_cloud(survey: str) -> Path:
    """Cloud of a survey."""
    return cloud(SURVEYS / survey, survey)


def survey_boundaries(survey: str) -> Path:
    """Polygons of a survey's parcels."""
    return boundaries(SURVEYS / survey)


def cloud(folder: Path, survey: str) -> Path:
    """Cloud of a survey in its folder."""
    return folder / f"{survey}.laz"


def boundaries(folder: Path) -> Path:
    """Polygons of a survey's parcels in its folder."""
    return folder / "parcels.gpkg"


def truth(folder: Path) -> Path:
    """What is true of a simulated survey."""
    return folder / "truth.gpkg"


def survey_products(survey: str) -> Path:
    """Folder of the products of a survey's parcels."""
    return PRODUCTS / survey


def prefect_home() -> Path:
    """Folder of the Prefect server that runs flows on a schedule: its database and its log."""
    return DATA / ".prefect"


def product_folder(survey: str, parcel: str) -> Path:
    """Folder of a parcel's product."""
    return parcel_folder(survey_products(survey), parcel)


def is_caseless(products: Path) -> bool:
    """Whether the disk of a survey's products takes small letters and capitals for the same.

    A disk that does has the lock of that folder under another name, too, while it is held.
    """
    held = lock(products)
    return sys.platform in ("win32", "darwin") or os.path.exists(held.with_name(held.name.upper()))  # noqa: PTH110


def parcel_folder(products: Path, parcel: str) -> Path:
    """Folder of a parcel's product among those of a survey."""
    return products / safe(parcel)


def geopackage(folder: Path, parcel: str) -> Path:
    """GeoPackage of a product."""
    return folder / f"{safe(parcel)}.gpkg"


def raster(folder: Path, parcel: str, kind: str) -> Path:
    """One of the rasters of a product."""
    return folder / f"{safe(parcel)}_{kind}.tif"


def raster_style(path: Path) -> Path:
    """Colours of a raster for QGIS, which looks for them beside it."""
    return path.with_suffix(".qml")


def project(folder: Path, parcel: str) -> Path:
    """QGIS project of a product."""
    return folder / f"{safe(parcel)}.qgz"


def canopy_mesh(folder: Path, parcel: str) -> Path:
    """Mesh of the canopies, as glTF."""
    return folder / f"{safe(parcel)}_canopy.glb"


def exported_mesh(folder: Path, parcel: str, kind: str) -> Path:
    """Mesh of the canopies in another format ("ply", "obj")."""
    return folder / f"{safe(parcel)}_canopy.{kind}"


def exported_frame(folder: Path, parcel: str) -> Path:
    """Frame of such a mesh."""
    return folder / f"{safe(parcel)}_canopy_frame.json"


def tileset(folder: Path) -> Path:
    """3D Tiles: of a parcel in its product's folder, of a survey in that of its products."""
    return folder / "tileset.json"


def classified_cloud(folder: Path, parcel: str) -> Path:
    """Cloud of a parcel with a class and a row for every point."""
    return folder / f"{safe(parcel)}_classified.laz"


def drive_frames(folder: Path) -> Path:
    """Folder of the frames of a robot's drive."""
    return folder / "frames"


def drive_frame(folder: Path, seconds: float) -> Path:
    """Frame of a robot's drive, named by its time."""
    return folder / f"{seconds:.3f}.png"


def drive_camera(folder: Path) -> Path:
    """File of the camera that took them."""
    return folder / "camera.yaml"


def track(folder: Path, drive: str) -> Path:
    """GeoPackage of a robot's track."""
    return folder / f"{drive}_track.gpkg"


def table_folder(folder: Path) -> Path:
    """Folder of the tables of all parcels that are exported together."""
    return folder / "table"


def export_folder(folder: Path, parcel: str, kind: str) -> Path:
    """Folder of a parcel in one of the formats of exports."""
    return parcel_folder(folder, parcel) / kind


def exported(folder: Path, parcel: str, layer: str, suffix: str) -> Path:
    """File of an export of a parcel."""
    return folder / f"{safe(parcel)}_{layer}{suffix}"


def exported_table(folder: Path, name: str, kind: str) -> Path:
    """Table of many products ("csv", "parquet")."""
    return folder / f"{name}.{kind}"


def data_package(folder: Path) -> Path:
    """What the columns of the tables beside it are: descriptor of a Data Package, in which tools look for them."""
    return folder / "datapackage.json"


def task_data(folder: Path) -> Path:
    """Folder of ISO 11783-10, in which terminals look for TASKDATA.XML."""
    return folder / "TASKDATA"


def agopengps_field(folder: Path, parcel: str) -> Path:
    """Folder of a field of AgOpenGPS, by whose name it is chosen there."""
    return parcel_folder(folder, parcel)


def agopengps_file(folder: Path, kind: str) -> Path:
    """File of a field of AgOpenGPS."""
    return folder / f"{kind}.txt"


def gazebo_mesh(folder: Path, kind: str) -> Path:
    """Mesh of a model of Gazebo."""
    return folder / f"{kind}.obj"


def gazebo_world(folder: Path, name: str) -> Path:
    """World of Gazebo in which a model stands."""
    return folder / f"{name}.sdf"


def ept_folder(folder: Path, kind: str) -> Path:
    """Where Entwine Point Tiles have their points ("data"), and the lists of their cubes ("hierarchy")."""
    return folder / f"ept-{kind}"


def ept_node(folder: Path, key: str, kind: str) -> Path:
    """Points of one of their cubes ("laz", "bin")."""
    return ept_folder(folder, "data") / f"{key}.{kind}"


def ept_page(folder: Path, key: str) -> Path:
    """A part of the list of their cubes."""
    return ept_folder(folder, "hierarchy") / f"{key}.json"


def piece(folder: Path, number: int) -> Path:
    """Points of one of a survey's parcels, while it is worked."""
    return folder / f"{number}.xyz"


def tile(folder: Path, column: int, row: int) -> Path:
    """Points of a tile of a cloud too large for memory."""
    return folder / f"{column}_{row}.xyz"


def draft(path: Path, suffix: str = "") -> Path:
    """Where a file or folder is made before it takes its place, beside it: another name each time."""
    return path.with_name(f".{path.name}.{uuid4().hex[:8]}.part{suffix}")


def tiles(folder: Path) -> Path:
    """Folder for the tiles of a cloud too large for memory, gone when the product is whole."""
    return folder / "tiles"


def run_record(folder: Path) -> Path:
    """Record of the run that made a product."""
    return folder / RUN


def lock(folder: Path) -> Path:
    """Lock of a folder of a survey's products."""
    return folder / ".lock"


def lock_beside(path: Path) -> Path:
    """Lock of a product's folder or a file, beside it."""
    return path.with_name(f".{path.name}.lock")


def survey_record(folder: Path) -> Path:
    """What became of the parcels of a survey, in the folder of their products."""
    return folder / "survey.json"


def stac_item(folder: Path, name: str) -> Path:
    """STAC item of a parcel in its product's folder, or of a survey in that of its products."""
    return folder / f"{safe(name)}_stac.json"


def stac_collection(folder: Path) -> Path:
    """STAC collection of a survey's products."""
    return folder / "collection.json"


def report(folder: Path, parcel: str) -> Path:
    """Page of a parcel, in its product's folder."""
    return folder / f"{safe(parcel)}_report.html"


def index(folder: Path) -> Path:
    """Page of a survey, in the folder of its products."""
    return folder / INDEX


def page_template(name: str) -> Path:
    """Template of a page."""
    return WEB / f"{name}.html"


def page_script(name: str) -> Path:
    """Script of a page, bundled."""
    return WEB / "dist" / f"{name}.js"
