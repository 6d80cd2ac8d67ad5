"""Settings shared by all tests."""

from hypothesis import HealthCheck, settings

# derandomize: a run on CI must not depend on luck; deadline: the first example pays for compiling kernels
settings.register_profile(
    "phytofit",
    derandomize=True,
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("phytofit")
