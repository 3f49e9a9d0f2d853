"""Vine rows and light canopy meshes from UAV point clouds of vineyards.

Modules import in one direction only::

    errors, crs, compiled <- cloud, raster, vector, mesh <- stages <- parcel <- cli, flows

The stages are ``ground``, ``row_field``, ``key_points``, ``clustering``, ``curves`` (rows) and
``sections``, ``canopy``, ``cgon`` (meshes). No stage opens a file; no stage imports another.
"""

__version__ = "0.2.0"
