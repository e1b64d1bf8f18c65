import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.sim.random import Component, stream, unit

SEED = 20250101


def draws(run, component=Component.IMU, shape=(7, 3)):
    return jax.random.normal(stream(SEED, run, component), shape)


def test_a_run_has_the_same_noise_alone_in_a_batch_and_in_any_order():
    runs = jnp.array([4, 137, 0, 9, 1])
    batch = jax.jit(jax.vmap(draws))(runs)
    for row, run in zip(np.asarray(batch), [4, 137, 0, 9, 1], strict=True):
        np.testing.assert_array_equal(row, draws(run))


def test_stream_is_the_documented_fold():
    key = jax.random.key(SEED, impl="threefry2x32")
    wanted = jax.random.fold_in(jax.random.fold_in(key, 5), 2)
    got = stream(SEED, 5, Component.GNSS)
    np.testing.assert_array_equal(jax.random.key_data(got), jax.random.key_data(wanted))


def threefry(key, x):
    """Threefry-2x32 with 20 rounds (Salmon et al. 2011), in plain arithmetic."""
    mask = 0xFFFFFFFF
    keys = [*key, key[0] ^ key[1] ^ 0x1BD11BDA]
    x = [(x[0] + keys[0]) & mask, (x[1] + keys[1]) & mask]
    for group in range(5):
        for turn in ((13, 15, 26, 6), (17, 29, 16, 24))[group % 2]:
            x[0] = (x[0] + x[1]) & mask
            x[1] = ((x[1] << turn) | (x[1] >> (32 - turn))) & mask
            x[1] ^= x[0]
        x[0] = (x[0] + keys[(group + 1) % 3]) & mask
        x[1] = (x[1] + keys[(group + 2) % 3] + group + 1) & mask
    return x


def test_streams_are_threefry_and_number_their_bits_in_order():
    # That rows drawn from one key do not depend on how many follow is what sensors rely on.
    seed, run, component = 2**40 + 5, 137, 2
    key = [seed >> 32, seed & 0xFFFFFFFF]
    for word in (run, component):
        key = threefry(key, [0, word])
    got = stream(seed, run, component)
    np.testing.assert_array_equal(jax.random.key_data(got), key)
    bits = np.ravel(jax.random.bits(got, (3, 2), dtype=jnp.uint64)).tolist()
    words = [threefry(key, [0, i]) for i in range(6)]
    assert bits == [(high << 32) | low for high, low in words]


def test_streams_do_not_depend_on_the_default_generator_of_jax():
    before = jax.random.key_data(stream(SEED, 3, Component.IMU))
    with jax.default_prng_impl("rbg"):
        after = jax.random.key_data(stream(SEED, 3, Component.IMU))
    np.testing.assert_array_equal(before, after)


def test_component_numbers_are_the_file_format():
    # Renumbering changes every result that was ever stored: this table may only grow.
    assert {c.name: int(c) for c in Component} == {
        "INITIAL_STATE": 0,
        "IMU": 1,
        "GNSS": 2,
        "TRAJECTORY": 3,
        "WIND": 4,
        "FLEXURE": 5,
        "BAROMETER": 6,
        "MAGNETOMETER": 7,
        "AIR_DATA": 8,
        "STAR_SENSOR": 9,
        "SAR": 10,
        "ODOMETER": 11,
        "FAULT": 12,
        "LINK": 13,
        "FILTER": 14,
        "SENSOR": 15,
    }


def test_units_of_a_kind_have_streams_of_their_own():
    numbers = [unit(c, i) for c in Component for i in range(4)]
    assert len(set(numbers)) == len(numbers)
    assert unit(Component.IMU, 0) == Component.IMU
    keys = {bytes(np.asarray(jax.random.key_data(stream(1, 0, n)))) for n in numbers}
    assert len(keys) == len(numbers)


def test_streams_of_neighbouring_names_are_uncorrelated():
    n = 4000
    rows = [draws(r, c, (n,)) for r in range(3) for c in (Component.IMU, Component.GNSS)]
    correlation = np.corrcoef(np.stack([np.asarray(r) for r in rows]))
    off = correlation[~np.eye(len(rows), dtype=bool)]
    assert np.abs(off).max() < 5.0 / np.sqrt(n)  # five sigma of a sample correlation


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((-1, 0, 1), "seed"),
        ((2**63, 0, 1), "seed"),
        ((True, 0, 1), "seed"),
        ((1, -1, 1), "run"),
        ((1, 2**32, 1), "run"),
        ((1, 0, -1), "component"),
    ],
)
def test_bad_names_are_refused(arguments, name):
    with pytest.raises(ValueError, match=f"^{name} must be an integer"):
        stream(*arguments)


def test_the_largest_names_work():
    keys = [stream(2**63 - 1, 2**32 - 1, 2**32 - 1), stream(2**63 - 1, 2**32 - 2, 2**32 - 1)]
    a, b = (np.asarray(jax.random.key_data(k)) for k in keys)
    assert np.any(a != b)


def test_a_run_that_is_not_whole_is_refused():
    with pytest.raises(ValueError, match=r"^run must be an integer from 0 to \d+, got 0\.5"):
        stream(1, 0.5, Component.IMU)


def test_numpy_integers_name_the_same_stream():
    a, b = stream(np.int64(7), np.int32(3), np.uint8(1)), stream(7, 3, 1)
    np.testing.assert_array_equal(jax.random.key_data(a), jax.random.key_data(b))
