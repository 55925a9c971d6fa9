"""Closed rooms hold what moves in them at large time steps, however bodies hit each other on their way."""

from warp_rigid.validation.robustness import escaped


def test_bodies_that_are_hit_on_their_way_stay_in_their_rooms(device):
    """Pushes and impacts after the last round took bodies through the walls of these rooms."""
    assert escaped([9, 16], 0.1, str(device), most=12) == 0
