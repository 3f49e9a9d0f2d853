"""What QGIS shows without a click: styles of layers and rasters, the project, the page to print."""
