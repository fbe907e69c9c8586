"""Images of the simulation: the raster, its smooth counterpart and the moving window."""
