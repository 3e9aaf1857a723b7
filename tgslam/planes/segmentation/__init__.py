"""The planes of one depth image (section 3.2): cells, their graph, agglomeration, pixels, judgement."""
