"""Device arrays of islands whose pairs are solved all at once in rounds (rounds.py)."""

import warp as wp

from warp_rigid.kernels.declare import Field, layout, packed_record

MOST_SHARING = 32
"""Maximum number of pairs that share a body's mass in rounds. With more, rounds converge too slowly."""

RoundRecord = packed_record(
    "RoundRecord",
    "A pair of bodies that is solved in rounds. The mass of a body is shared equally by all its contacts.",
    body_a=Field(int, "", "", "first body"),
    body_b=Field(int, "", "", "second body"),
    begin=Field(int, "", "", "first contact"),
    end=Field(int, "", "", "one past the last contact"),
    env=Field(int, "", "", "environment"),
    limit=Field(int, "", "", "maximum number of rounds"),
    tolerance=Field(float, "", "m/s", "largest velocity change with which rounds end"),
    sharing_a=Field(int, "", "", "contacts that share the first body's mass"),
    sharing_b=Field(int, "", "", "contacts that share the second body's mass"),
    first_a=Field(int, "", "", "first slot of the first body"),
    end_a=Field(int, "", "", "one past its last slot; `first_a` if it has none, since it is not dynamic"),
    first_b=Field(int, "", "", "first slot of the second body"),
    end_b=Field(int, "", "", "one past its last slot"),
    slot_a=Field(int, "", "", "slot of this pair among those of the first body; -1 if it has none"),
    slot_b=Field(int, "", "", "slot of this pair among those of the second body"),
    constraint=Field(int, "", "", "index of the pair in `Constraints`"),
    rolls=Field(int, "", "", "1: the pair has rolling or spinning friction"),
)

Rounds = layout(
    "Rounds",
    "Pairs of bodies that are solved all at once in rounds (rounds.py): all, or those with impacts or overlaps.",
    pairs=Field(RoundRecord, "crowd_pairs", "", "the pairs, in any order"),
    count=Field(int, "1", "", "number of pairs"),
    sharing=Field(int, "crowd", "", "contacts that share the body's mass"),
    last_change=Field(int, "envs", "", "last round in which a velocity changed by more than the tolerance"),
    visited=Field(int, "crowd_pairs", "", "last round in which the pair was solved"),
    largest_target=Field(float, "envs", "m/s", "of the push-out: largest separation speed that a contact requires"),
    done=Field(int, "1", "", "rounds completed before those of this launch"),
    latest=Field(int, "1", "", "last round after which an environment needs another one"),
    again=Field(int, "1", "", "1: more rounds follow"),
)

ChangeRecord = packed_record(
    "ChangeRecord",
    "Velocity change of a body by the impulses of one pair.",
    linear=Field(wp.vec3, "", "m/s", "linear velocity change"),
    stirring=Field(float, "", "", "1: the last round changed it noticeably"),
    angular=Field(wp.vec3, "", "rad/s", "angular velocity change"),
    turning=Field(float, "", "", "the same as `stirring`, next to the angular velocity"),
)

Slots = layout(
    "Slots",
    "Velocity changes of bodies by each of their pairs. A dynamic body has a slot for each pair.",
    used=Field(int, "1", "", "number of slots of all bodies"),
    count=Field(int, "crowd", "", "slots of the body"),
    first=Field(int, "crowd", "", "first slot of the body; its slots are in the order of the constraints"),
    members=Field(int, f"crowd, {MOST_SHARING}", "", "constraints of the body's pairs, in any order"),
    changes=Field(
        ChangeRecord,
        "crowd_pairs + crowd_pairs + crowd_pairs + crowd_pairs",
        "",
        "two buffers of slots: one is read in a round, the other written",
    ),
)
