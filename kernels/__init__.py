"""The stages of a step as Warp kernels, one module per stage.

`schema` declares every device array once. The stages are in `update` (prediction, integration, sleeping), `collide`
(broad phase, narrow phase, continuous collision detection), `constraints`, `graph` (supports, levels, islands, colours)
and `solve`. `common` holds device functions shared by all stages. No module here imports the host classes.
"""
