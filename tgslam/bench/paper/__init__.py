"""`tgslam bench paper`: the paper's tables beside what whole runs reach here on the same recordings."""
