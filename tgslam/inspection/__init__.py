"""What a recording is, and what seems wrong with it, before anything is reconstructed from it."""
