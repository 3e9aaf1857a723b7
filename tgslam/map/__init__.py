"""The state of the world: keyframes and Gaussians. Everything else reads it, and changes it through what is here."""
