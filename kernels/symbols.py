"""Symbols in the shapes of the arrays that `schema` declares."""

SYMBOLS = {
    "envs": "environments",
    "bodies": "bodies of all environments",
    "filtered": "bodies that a body never touches, over all bodies",
    "shapes": "shapes in the pool",
    "parts": "signed distance functions in the pool",
    "clusters": "sample clusters in the pool",
    "samples": "surface samples in the pool",
    "balls": "inner balls of the shapes in the pool",
    "hull_vertices": "vertices of convex meshes in the pool",
    "nodes": "grid nodes in the pool",
    "tree_nodes": "nodes of trees of triangles in the pool",
    "triangles": "triangles of meshes in the pool",
    "vertices": "vertices of moving height fields",
    "watches": "watches of each environment",
    "fields": "force fields besides gravity, over all environments",
    "field_parameters": "parameters of the force field that has most",
    "boxed": "bodies with fat boxes; 0 if every pair is tested",
    "buckets": "buckets of the hash grid, over all environments",
    "candidates": "capacity for candidate pairs",
    "pairs": "capacity for pairs of bodies",
    "near_samples": "capacity for samples that may touch, of all searched pairs",
    "contacts": "capacity for contacts",
    "crowd": "bodies; 0 if no environment has more than 128",
    "crowd_pairs": "capacity for pairs; 0 if no environment has more than 128 bodies",
}
"""What the symbols in the shapes of arrays count."""
