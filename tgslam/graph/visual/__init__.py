"""Visual loop closures: keyframes that show the same place. No part of the method, and off by default."""
