"""Frames that come as they are taken: from another process by a stream of bytes, or from a camera."""
