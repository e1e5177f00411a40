"""What an elite's certificate would claim, as the checker reads it."""

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.closed_loop import claim_of, double, with_digests


def claimed(elite):
    """The claim of the whole motion, without a push."""
    told = {**claim_of(elite), "start": [0, double(0.0)], "push": double(0.0)}
    return check.read_claim(check.Node("claim", with_digests(told)))
