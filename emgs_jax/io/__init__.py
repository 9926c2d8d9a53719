"""Files of maps, clouds, meshes and trajectories; every write is atomic."""
