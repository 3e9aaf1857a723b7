"""The rasterizer's stages on each device, behind one interface."""
