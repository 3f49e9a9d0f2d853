"""A product in Open3D: what is shown of it, and a window or a picture of that."""
