"""Writers of tiny recordings in the layouts that tgslam reads, each from the same three frames."""
