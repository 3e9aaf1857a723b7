"""Motions between keyframes far apart: structure closures (section 3.3) measure them through the planes that both see,
visual ones, which are no part of the method and off by default, through what the two images show.
"""
