"""The stages of a step as Warp kernels, one stage a module, in the order in which data flows.

`data` declares every device array once. `distance` answers "how far, and which way" for every shape. Then come the
stages: `predict`, `broadphase`, `narrowphase`, `contacts`, `support`, `ordering`, `collisions`, `impulses`, `shock`,
`push_out` and `integrate`. No module here knows the host classes.
"""
