"""The passes of the objective on each device, behind one interface."""
