"""When a frame becomes a keyframe (section 3.1): co-visibility, baseline and the structure cue."""
