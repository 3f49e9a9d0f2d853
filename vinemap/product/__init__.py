"""What a run leaves in a parcel's folder: layers, rasters, glTF, 3D Tiles, STAC, the record of the run.

What a layer holds is said in `layers.py`; QGIS's styles and projects are in `qgis`, pages for the browser in `pages`. A
product's recipe tells whether it is up to date, its store puts it in place whole or not at all.
"""
