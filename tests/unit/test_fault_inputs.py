"""Faults by name, and what is refused."""

import pytest

import quad_gym
from quad_gym.faults import (
    CameraOcclusion,
    Fault,
    GnssJump,
    GnssOutage,
    RotorLoss,
    WrongAssociations,
)
from quad_gym.faults.presets import ALL, PRESETS, faults_of
from quad_gym.records import Aid, FaultKind

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
AIDED = RTK.replace(
    barometer=quad_gym.BarometerParams(),
    magnetometer=quad_gym.MagnetometerParams(),
    optical_flow=quad_gym.OpticalFlowParams(),
    range_finder=quad_gym.RangeFinderParams(),
)
ONE_FEATURE = LAB.replace(camera=LAB.camera.replace(features_I=((0.0, 0.0, 0.0),)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: GnssOutage(start=(3.0, 1.0)), r"GnssOutage.start must be \(low, high\)"),
        (lambda: GnssOutage(start=(1.0, 2.0, 3.0)), r"must be a number or \(low, high\)"),
        (lambda: GnssOutage(duration=0.0), "GnssOutage.duration must be greater than 0"),
        (lambda: GnssOutage(start=1.0, rate=0.1), "start or rate, not both"),
        (lambda: GnssOutage(probability=1.5), "GnssOutage.probability must be at most 1"),
        (lambda: GnssJump(direction=(0.0, 0.0, 0.0)), "GnssJump.direction must not be zero"),
        (lambda: WrongAssociations(how="mix"), "WrongAssociations.how must be one of swap, copy"),
        (lambda: RotorLoss(share=1.2), "RotorLoss.share must be at most 1"),
        (lambda: RotorLoss(rotor=4), "RotorLoss.rotor must be 0, 1, 2 or 3"),
        (lambda: Fault(), "of a kind"),
        (lambda: faults_of("gnss_outtage", LAB), "faults must be one of none, gnss_outage"),
        (lambda: faults_of(3, LAB), "faults must be faults or names of presets, got 3"),
        (lambda: faults_of([3], LAB), "faults must be faults or names of presets, got 3"),
        (lambda: faults_of([GnssOutage(), "gnss_outage"], LAB), "one of each kind, got two Gnss"),
        (lambda: faults_of(GnssOutage(), quad_gym.sensor_suite("indoor")), "needs GNSS"),
        (lambda: faults_of(CameraOcclusion(), LAB.replace(camera=None)), "needs a camera"),
        (lambda: faults_of(WrongAssociations(), ONE_FEATURE), "two features"),
    ],
)
def test_invalid_faults_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_presets_by_name():
    assert faults_of(None, LAB) == faults_of("none", LAB) == faults_of((), LAB) == ()
    kinds = {fault.kind for preset in PRESETS.values() for fault in preset}
    assert kinds <= set(FaultKind)  # some faults have no name
    named = faults_of("rotor_loss+gnss_outage", LAB)
    assert [type(fault) for fault in named] == [GnssOutage, RotorLoss]
    assert named == faults_of(["rotor_loss", PRESETS["gnss_outage"][0]], LAB)
    assert len(faults_of(ALL, AIDED)) == len(kinds)
    assert len(faults_of(ALL, RTK)) == len(kinds) - len(Aid)
    for suite in ("consumer", "indoor"):
        assert 0 < len(faults_of(ALL, quad_gym.sensor_suite(suite))) < len(FaultKind)
