"""Articulated objects as URDF files with meshes: import into and export from the generator."""
