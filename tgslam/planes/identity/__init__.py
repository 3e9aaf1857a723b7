"""What a plane's identity looks like in a rendering (Eqs. 1 to 3), and how it is read back."""
