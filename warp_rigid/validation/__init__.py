"""Validation: cases with closed forms or published references, as data; `warp-rigid validate` runs them."""
