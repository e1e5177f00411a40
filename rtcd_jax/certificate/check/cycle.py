"""Motions that follow one another: the reset at the end of each leads into the first ellipsoid of the next one."""

from collections.abc import Sequence

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import require


def require_cycle(motions: Sequence[tuple[Claim, list]]) -> None:
    """Refuses proved motions that do not follow one another in this order, the first one after the last. Each is its
    claim and the axes of its first ellipsoid.
    """
    for i, ((claim, _), (ahead, inlet)) in enumerate(zip(motions, [*motions[1:], motions[0]], strict=True)):
        place, catch = f"certificate {i + 1}", claim.catch
        require(catch is not None and catch.reset is not None, place, "does not end in a reset")
        assert catch is not None
        require(ahead.start == (0, 0), place, "is followed by one that is not proved from t = 0 on")
        there = catch.center == ahead.x[0] and catch.axes == inlet
        require(there, place, "its catch set is not the first ellipsoid of the one that follows")
        require(claim.robot == ahead.robot, place, "is followed by one about another robot")
        same = claim.ranges_after == ahead.parameters
        require(same, place, "the robot's numbers after its reset are not those of the one that follows")
        require(claim.limits == ahead.limits, place, "is followed by one with another limit of the motor")


def cycle_sentence(digests: Sequence[str]) -> str:
    """What follows of motions that `require_cycle` does not refuse, by the digests of their claims."""
    one = len(digests) == 1
    motions = "this motion is" if one else f"these {len(digests)} motions are"
    following = "its first one" if one else "the first one of the motion that follows, of the last in the first"
    return (
        f"PROVED that {motions} a cycle: what the reset at the end makes of the last ellipsoid lies in {following}. A "
        f"robot that is in a funnel at some time stays in the funnels for ever, motion after motion, if each reset "
        f"comes at its instant and is as claimed. Claims: sha256 {', '.join(digests)}."
    )
