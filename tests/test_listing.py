"""The order of frames by their names."""

from caper_jax.data.listing import natural_order


def test_natural_order():
    names = ["10", "9", "a10", "a9", "09", "a9b", "a"]
    assert sorted(names, key=natural_order) == [
        "09", "9", "10", "a", "a9", "a9b", "a10",
    ]  # fmt: skip
