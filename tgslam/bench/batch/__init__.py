"""`tgslam batch`: many recordings, each with settings of its own, and one table of what became of them."""
