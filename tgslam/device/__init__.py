"""The Taichi runtime, the arrays that live on its device, and what makes its start quicker."""
