"""Parts from which scenes are built: grounds, bins, stacks, piles, meshes. Scenes, benchmarks and tests share them."""
