"""Images of the simulation, as robots observe it: the camera, the raster and its smooth counterpart, in C++ too."""
