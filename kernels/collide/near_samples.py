"""Declaration of the lists of samples, over all pairs: those that may touch in a step, and those that are traced."""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.declare import Field, layout

NARROWPHASE = wp.get_module("warp_rigid.kernels.collide.narrowphase")
"""Module of the kernels of the narrow phase. They are compiled together, as they share functions of distances."""

NearSamples = layout(
    "NearSamples",
    "Samples that may touch in a step: first those of searched pairs, each of which has a chain of batches in sample "
    "order, then those of the contacts that other pairs keep.",
    begin=Field(int, "2", "", "number of samples of each kind before the second search"),
    count=Field(int, "2", "", "number of samples of each kind, also of those that do not fit"),
    first=Field(int, "pairs", "", "first sample of the first batch of a searched pair, -1 if it has none"),
    next=Field(int, "near_samples", "", "at the first sample of a batch: that of the pair's next batch, or -1"),
    end=Field(int, "near_samples", "", "at the first sample of a batch: one past its last sample"),
    pair=Field(int, "near_samples + contacts", "", "the sample's pair"),
    key=Field(
        int,
        "near_samples + contacts",
        "",
        "identity of the contact: 2 * sample + side; negative if it belongs to no sample",
    ),
    position=Field(wp.vec3, "near_samples + contacts", "m", "contact point in the world frame"),
    normal=Field(wp.vec3, "near_samples + contacts", "", "contact normal in the world frame"),
    gap=Field(
        float, "near_samples + contacts", "m", "distance at the start of the step; FAR if the sample does not touch"
    ),
    left=Field(float, "near_samples", "m", "distance at the end of the step if the bodies move on as before"),
    closing=Field(int, "near_samples", "", "1 if the gap may close in the step"),
)

Suspects = layout(
    "Suspects",
    "Samples that continuous collision detection traces in an iteration, in any order.",
    iteration=Field(int, "1", "", "number of the iteration, from 0"),
    again=Field(int, "1", "", "1: another iteration follows"),
    sampled=Field(int, "1", "", "1: samples are traced in this iteration, of pairs that are not both convex solids"),
    count=Field(int, "1", "", "number of samples, also of those that do not fit"),
    pair=Field(int, "near_samples", "", "the sample's pair"),
    side=Field(int, "near_samples", "", "0: sample of the pair's first body, 1: of the second one"),
    sample=Field(int, "near_samples", "", "index of the sample; -1 for the centre of the body"),
    begin=Field(float, "near_samples", "s", "the sample cannot penetrate before this time"),
    allowed=Field(float, "near_samples", "m", "depth of penetration at which its body is stopped"),
    reached_count=Field(int, "1", "", "number of bodies of traced pairs whose bounding sphere reaches the other body"),
    reached=Field(int, "pairs, 2", "", "these bodies, in any order: 2 * pair + side"),
    cluster_count=Field(int, "1", "", "number of clusters of these bodies that reach the other body"),
    cluster=Field(int, "near_samples", "", "these clusters, in any order"),
    cluster_body=Field(int, "near_samples", "", "the cluster's body: 2 * pair + side"),
    cluster_begin=Field(float, "near_samples", "s", "time at which the cluster reaches the other body"),
    untraced=Field(float, "pairs", "m", "upper bound of the relative motion of a pair that has not been traced"),
    impact=Field(
        float, "pairs", "s", "of a traced pair: earliest time at which a sample is too deep, or the time step"
    ),
)


class Group(IntEnum):
    """Groups of near samples, as indices of NearSamples.begin and count."""

    SEARCHED = 0
    KEPT = 1
    """Those of kept contacts."""
