"""The line search over the whole contact solver: impulses add no energy."""

import pytest

from warp_rigid.validation import towers


@pytest.mark.long
def test_impulses_add_no_energy_to_falling_piles(device):
    """Twelve piles of 40 bodies, relative to the energy of their fall; unless searched, two gain more than 1e-4."""
    [pile] = towers.falling_piles(2.0, 40).experiments
    gain = towers.gained(lambda t: t.work_free_energy)(pile.run(str(device)))
    assert len(gain) == 13
    assert gain.max() < 4e-6
