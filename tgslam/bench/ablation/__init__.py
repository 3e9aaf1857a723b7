"""`tgslam bench ablation`: whole runs with parts of the method left out, side by side; and Fig. 6 on one frame."""
