"""Which device speaks which dialect: later vendor data sheets and both manuals."""

from dataclasses import replace

import pytest
from pydantic import ValidationError

from ldcnd.drives.ldcn import config
from ldcnd.drives.ldcn.profiles import PROFILES, HomingControl, Support, identify


@pytest.mark.parametrize(
    ("device_id", "version", "name"),
    [
        (0, 1, "pic-servo-v1"),
        (0, 2, "pic-servo-v2"),
        (0, 3, "pic-servo-v3"),
        (0, 4, "pic-servo-v4"),
        (0, 5, "pic-servo-cmc"),
        (0, 10, "pic-servo-sc"),
        (0, 20, "ls-231"),
        (0, 39, "ls-231"),
        (0, 60, "ls-173"),
        (0, 79, "ls-173"),
        (2, 1, "pic-io"),
        (2, 52, "sk-2310g2"),
        (3, 7, "pic-step"),
        (90, 1, "ls-173ap"),
        (90, 19, "ls-173ap"),
        (90, 20, "ls-182ap"),
        (90, 22, "ls-182ap"),
        (90, 255, "ls-182ap"),
    ],
)
def test_id_and_version_choose_the_dialect(device_id, version, name):
    profile = identify(device_id, version)

    assert profile is PROFILES[name]


@pytest.mark.parametrize(("device_id", "version"), [(0, 0), (0, 6), (0, 40), (1, 1), (90, 0), (255, 255)])
def test_an_undescribed_device_has_no_dialect(device_id, version):
    assert identify(device_id, version) is None


def test_no_identity_belongs_to_two_dialects():
    claims = [(p.device_id, version) for p in PROFILES.values() for version in p.versions]

    assert len(claims) == len(set(claims))


def test_only_described_servo_drives_are_moved():
    full = {name for name, profile in PROFILES.items() if profile.support is Support.FULL}

    assert full == {name for name in PROFILES if name.startswith("pic-servo-")} | {"ls-173ap", "ls-182ap"}


def test_the_converter_fits_its_bytes():
    assert all(profile.adc_bits <= 8 * profile.adc_bytes for profile in PROFILES.values())


def test_logosol_homes_without_current_limit_and_ls_173ap_without_limits():
    assert not PROFILES["ls-182ap"].homing_sources & HomingControl.CURRENT
    assert PROFILES["ls-173ap"].homing_sources == HomingControl.INDEX | HomingControl.POSITION_ERROR


def test_the_motion_lock_begins_with_a_version_of_its_own():
    locks = {name: p.motion_lock_from for name, p in PROFILES.items() if p.motion_lock_from is not None}

    assert locks == {"ls-182ap": 22}


def test_a_model_whose_divisor_misses_the_top_rate_is_refused_it_before_anything_is_opened(monkeypatch):
    fast = replace(PROFILES["ls-182ap"], top_baud=230_400)
    monkeypatch.setattr(config, "PROFILES", {**PROFILES, "ls-182ap": fast})
    axis = {"name": "x", "address": 1, "model": "ls-182ap", "velocity": 1, "acceleration": 1, "counts_per_unit": 1}
    with pytest.raises(ValidationError, match="no divisor of ls-182ap at address 1 makes it"):
        config.LdcnBusConfig(name="line", port="sim:line", family="ldcn", baud=230_400, axis=[axis])
