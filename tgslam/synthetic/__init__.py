"""Built-in synthetic RGB-D scenes with exact depth, poses and planes, rendered frame by frame."""

from tgslam.synthetic.scenes import SCENES

__all__ = ["SCENES"]
