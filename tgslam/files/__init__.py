"""What several rooms need to read and write files: TUM's text rows, and files that appear whole or not at all."""
