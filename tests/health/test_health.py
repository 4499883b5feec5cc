"""Health from trims and in flight: each damage is named with its size, healthy flights are left alone."""

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover, hover_seconds, squared_speeds
from quadid_evaluation.studies.health.hours import alarms, named, practised
from quadid_evaluation.studies.health.simulated import SIMULATORS, Case, judged

from quadid.app.health import change_words, health_verdict
from quadid.condition import Health, assess, flight_trim, healthy_spread
from quadid.condition import changes as change_evidence
from quadid.condition.changes import exact, hypotheses, p_healthy, p_unchanged, rotor_effect
from quadid.condition.trim import trim_directions, trim_of_load
from quadid.condition.watch import ENOUGH, HealthWatch
from quadid.data.window import Recording
from quadid.errors import NotIdentifiableError
from quadid.vehicle import GRAVITY, Command, Vehicle

# --- Health from trims: each damage is named with its size, healthy flights are left alone, whatever the airframe


PELICAN_X, PELICAN = Vehicle.shipped("pelican_x"), Vehicle.shipped("pelican")


def compared(vehicle: Vehicle, wrong: Wrong | None, seed: int, baselines: int = 6) -> Health:
    healthy = [flight_trim(hover(vehicle, seed=1000 * seed + k), vehicle) for k in range(1, baselines + 1)]
    return assess([flight_trim(hover(vehicle, wrong, seed=1000 * seed), vehicle)], healthy, vehicle)


def changes_of(found: Health) -> dict[str, dict[str, float]]:
    """Numbers of the changes, by effect; of several rotors by ``weak_rotor 3``."""
    out = {}
    for change in found.changes:
        numbers = {name: value for name, _, value, _ in change.parameters}
        rotor = numbers.pop("rotor", None)
        out[change.effect if rotor is None else f"{change.effect} {rotor:.0f}"] = numbers
    return out


@pytest.mark.parametrize("name", ["pelican", "pelican_x", "crazyflie_brushless", "hummingbird"])
@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_a_weak_rotor_is_named_with_its_loss(name: str, rotor: int) -> None:
    vehicle = Vehicle.shipped(name)
    found = compared(vehicle, Wrong({rotor: 0.15}, {rotor: 0.15}), seed=rotor)
    assert found.verdict == "changed"
    assert list(changes_of(found)) == [f"weak_rotor {rotor}"]
    assert changes_of(found)[f"weak_rotor {rotor}"]["loss"] == pytest.approx(0.15, abs=0.04)
    assert found.changes[0].confident


@pytest.mark.parametrize(
    ("name", "losses", "seed"), [("hexacopter", {2: 0.25}, 5), ("pelican_x", {1: 0.25, 2: 0.15}, 6)]
)
def test_weak_rotors_are_named_first(name: str, losses: dict[int, float], seed: int) -> None:
    found = compared(Vehicle.shipped(name), Wrong(losses, losses), seed=seed)
    assert list(changes_of(found))[: len(losses)] == [f"weak_rotor {rotor}" for rotor in losses]
    assert len(losses) == 1 or len(found.changes) == len(losses)


def test_a_flight_far_from_its_only_baseline_in_every_trim_is_not_called_unchanged() -> None:
    baseline = flight_trim(hover(PELICAN_X, seed=1), PELICAN_X)
    another = baseline._replace(mean=baseline.mean + [0.02, 0.03, 0.11, 0.54])
    found = assess([another], [baseline], PELICAN_X)
    assert (found.verdict, found.changes) == ("unknown", ())


def test_what_draws_of_healthy_flights_show_is_found_once_for_all_flights_after_a_baseline() -> None:
    """A fleet compares each flight of a vehicle with the same first ones; each alone would draw them again."""
    baseline = [flight_trim(hover(PELICAN_X, seed=1000 + k), PELICAN_X) for k in range(5)]
    change_evidence._evidence_of_draws.cache_clear()
    found = [assess([flight_trim(hover(PELICAN_X, seed=k), PELICAN_X)], baseline, PELICAN_X) for k in range(3)]
    assert change_evidence._evidence_of_draws.cache_info().misses == 1
    for one in found:
        change_evidence._evidence_of_draws.cache_clear()
        assert p_unchanged(one.trim - one.healthy.mean, one.healthy, 1, PELICAN_X) == one.p_value


def test_a_change_that_two_baseline_flights_cannot_show_is_not_called_unchanged() -> None:
    """It is said how many more would, if they differ no more than these."""
    small = Wrong({3: 0.06}, {3: 0.06})
    few = compared(PELICAN_X, small, seed=1, baselines=2)
    assert (few.verdict, few.lacking) == ("unknown", 2)
    assert few.p_value > 0.01
    more = few.healthy.known_from(2 + few.lacking)
    assert p_unchanged(few.trim - few.healthy.mean, more, 1, PELICAN_X) < 0.01
    assert not any(change.confident for change in few.changes)
    verdict = health_verdict({**few.to_dict(), "baseline": ["a", "b"]})
    assert (verdict.level, verdict.headline[:28]) == ("fair", "2 baseline flights do not sh")
    assert "2 healthy flights or more" in verdict.next_steps[0]
    healthy = compared(PELICAN_X, None, seed=1, baselines=2)
    assert (healthy.verdict, healthy.lacking) == ("unchanged", 0)


def test_thrust_and_drag_may_be_lost_in_different_shares() -> None:
    found = compared(PELICAN_X, Wrong({4: 0.2}, {4: 0.05}), seed=7)
    numbers = changes_of(found)["weak_rotor 4"]
    assert numbers["loss"] == pytest.approx(0.2, abs=0.05)
    assert numbers["drag_loss"] < 0.13


def test_a_weight_on_an_arm_is_a_payload_and_no_rotor() -> None:
    place = PELICAN_X.rotors[2].position
    found = compared(PELICAN_X, Wrong(mass=0.15 * PELICAN_X.mass, place=place[:2]), seed=8)
    assert set(changes_of(found)) == {"mass_change", "cg_offset"}
    assert changes_of(found)["mass_change"]["fraction"] == pytest.approx(0.15, abs=0.05)
    shift = 0.15 / 1.15 * np.array(place[:2])
    assert changes_of(found)["cg_offset"]["x"] == pytest.approx(shift[0], rel=0.3)
    assert changes_of(found)["cg_offset"]["y"] == pytest.approx(shift[1], rel=0.3)


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_the_report_says_which_way_the_centre_of_gravity_moved(rotor: int) -> None:
    x, y, _ = PELICAN_X.rotors[rotor - 1].position
    found = compared(PELICAN_X, Wrong(mass=0.15 * PELICAN_X.mass, place=(x, y)), seed=8)
    (words,) = (change_words(c) for c in found.to_dict()["changes"] if c["effect"] == "cg_offset")
    assert ("forward" in words, "right" in words) == (x > 0.0, y > 0.0)
    assert "-" not in words


def test_a_light_weight_on_an_arm_is_mostly_no_rotor() -> None:
    """Its look-alike, a rotor that lost thrust and no drag torque, is rare: blades lose both."""
    called = []
    for seed in range(70, 90):
        place = PELICAN_X.rotors[seed % 4].position
        called.append(
            compared(PELICAN_X, Wrong(mass=0.05 * PELICAN_X.mass, place=place[:2]), seed=seed).changes[0].effect
        )
    assert called.count("weak_rotor") <= 10


@pytest.mark.parametrize(
    ("command", "effect", "rival", "size"),
    [
        (PELICAN.command, "mass_change", "thrust_drop", 0.14),
        (Command(kind="normalized", max_speed=900.0), "thrust_drop", "mass_change", 1.0 - 1.0 / 1.15),
    ],
)
def test_more_effort_in_the_same_balance_is_a_mass_by_speed_and_thrust_by_command(
    command: Command, effect: str, rival: str, size: float
) -> None:
    (change,) = compared(PELICAN.model_copy(update={"command": command}), Wrong(effort=0.15), seed=9).changes
    assert change.effect == effect
    assert change.rivals[0].effects == (rival,)
    assert change.parameters[0][2] == pytest.approx(size, abs=0.03)


def test_healthy_flights_are_left_alone() -> None:
    verdicts = [compared(PELICAN_X, None, seed).verdict for seed in range(20, 60)]
    assert verdicts.count("unchanged") >= 38  # at 1 %, more than 2 of 40 has a chance of 1 %


def test_the_score_grows_with_the_damage() -> None:
    scores = [compared(PELICAN_X, Wrong({3: loss}, {3: loss}), seed=3).score for loss in (0.0, 0.05, 0.1, 0.2, 0.3)]
    assert scores == sorted(scores)


def test_one_baseline_flight_is_enough_for_a_large_loss_only() -> None:
    large = compared(PELICAN_X, Wrong({3: 0.3}, {3: 0.3}), seed=4, baselines=1)
    small = compared(PELICAN_X, Wrong({3: 0.02}, {3: 0.02}), seed=4, baselines=1)
    assert (large.verdict, small.verdict) == ("changed", "unchanged")
    assert not any(change.confident for change in small.changes)


def test_effects_of_the_hypotheses_are_those_of_balance() -> None:
    """Each column against the exact balance of a slightly damaged vehicle: linear to second order."""
    trim, small = np.zeros(4), 1e-4
    vehicle, none = PELICAN_X, np.zeros(4)
    directions = trim_directions(vehicle)

    def trims(wrong: Wrong) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        w, mass = squared_speeds(vehicle, wrong, none), 1.0 + wrong.mass / vehicle.mass
        felt = np.log(w.sum() / squared_speeds(vehicle, Wrong(), none).sum())
        assert mass >= 1.0
        return np.array([*(directions @ w / w.sum()), felt])

    offered = hypotheses(vehicle, np.full(4, 0.25), trim)
    for one in offered:
        if one.kind == "weak_rotor" and len(one.rotors) == 1:
            (j,) = one.rotors
            for k, wrong in enumerate((Wrong({j + 1: small}), Wrong({}, {j + 1: small}))):
                np.testing.assert_allclose(trims(wrong) / small, one.effect[:, k], atol=2e-3)
    payload = next(one for one in offered if one.kind == "payload")
    moved = trims(Wrong(mass=small * vehicle.mass, place=(0.1, 0.05)))
    numbers = np.array([0.1 / vehicle.arm, 0.05 / vehicle.arm, 1.0])
    np.testing.assert_allclose(moved / small, payload.effect @ numbers, atol=2e-3)


def test_lost_thrust_adds_up_rotor_by_rotor_however_large() -> None:
    lost, drag = {1: 0.3, 2: 0.15}, {1: 0.2, 2: 0.25}
    before, after = (squared_speeds(PELICAN_X, one, np.zeros(4)) for one in (Wrong(), Wrong(lost, drag)))
    trim, changed = (trim_of_load(w, GRAVITY, PELICAN_X) for w in (before, after))
    offered = hypotheses(PELICAN_X, after / after.sum(), trim)
    both = next(one for one in offered if one.rotors == (0, 1))
    np.testing.assert_allclose(exact(changed - trim), both.effect @ [0.3, 0.2, 0.15, 0.25], atol=1e-12)


def test_the_verdict_s_p_value_is_uniform_and_finds_lost_thrust_rather_than_gained() -> None:
    healthy = healthy_spread([flight_trim(hover(PELICAN_X, seed=k), PELICAN_X) for k in range(1, 7)])
    rng = np.random.default_rng(8)
    draws = healthy.predictive(1) * rng.standard_t(healthy.freedom, size=(100, 4))
    p = np.array([p_unchanged(draw, healthy, 1, PELICAN_X) for draw in draws])
    for level in (0.05, 0.5):
        assert np.mean(p <= level) == pytest.approx(level, abs=4.0 * np.sqrt(level * (1 - level) / len(p)))
    lost = 0.05 * rotor_effect(PELICAN_X, 2, 0.25, healthy.mean).sum(axis=1)
    chances = [p_unchanged(change, healthy, 1, PELICAN_X) for change in (lost, -lost)]
    assert chances[0] < p_healthy(lost, healthy.predictive(1), healthy.freedom)
    assert chances[0] < chances[1]


def test_p_values_of_healthy_flights_are_uniform() -> None:
    """Drawn from the model of the spread itself, with its few degrees of freedom."""
    rng = np.random.default_rng(5)
    freedom = np.array([6.0, 6.0, 3.0, 3.0])
    draws = rng.normal(size=(4000, 4)) / np.sqrt(rng.chisquare(freedom, size=(4000, 4)) / freedom)
    p = np.array([p_healthy(row, np.ones(4), freedom) for row in draws])
    for level in (0.01, 0.1, 0.5):
        assert np.mean(p < level) == pytest.approx(level, abs=4.0 * np.sqrt(level * (1 - level) / 4000))


def test_spread_comes_from_baselines_and_is_shared_by_roll_and_pitch() -> None:
    flights = [flight_trim(hover(PELICAN_X, seed=k, spread=0.04), PELICAN_X) for k in range(1, 40)]
    wide = healthy_spread(flights)
    # A rotor's share of 1/4 times its sd, four of them, over sqrt(2) of the diagonal arms; yaw without that.
    np.testing.assert_allclose(wide.deviation[:3], [0.0141, 0.0141, 0.02], rtol=0.25)
    assert wide.deviation[0] == wide.deviation[1]


def test_partial_channels_are_enough() -> None:
    vehicle = PELICAN_X
    whole = hover(vehicle, Wrong({3: 0.2}, {3: 0.2}), seed=1)
    bare = Recording(whole.name, whole.format, {"rotor_speed": whole.channels["rotor_speed"]})
    a, b = flight_trim(whole, vehicle), flight_trim(bare, vehicle)
    np.testing.assert_allclose(a.mean[:3], b.mean[:3], atol=2e-3)
    assert "hover" in b.channels


def test_too_little_flight_is_refused_with_what_is_needed() -> None:
    with pytest.raises(NotIdentifiableError, match="5 s or more between take-off and landing"):
        flight_trim(hover(PELICAN_X, seconds=4.0), PELICAN_X)


@pytest.mark.parametrize(("added", "asked"), [(0.05, False), (0.5, True)])
@pytest.mark.parametrize("baselines", [1, 6])
def test_a_change_as_between_two_vehicles_asks_first_whether_they_are_one(
    added: float, asked: bool, baselines: int
) -> None:
    found = compared(PELICAN_X, Wrong(mass=added * PELICAN_X.mass), seed=1, baselines=baselines)
    verdict = health_verdict({**found.to_dict(), "baseline": ["a"] * baselines})
    assert any(step.startswith("Check that all flights are of one vehicle") for step in verdict.next_steps) == asked


# --- Health in flight: a loss is named within five seconds, healthy hours stay quiet, a missing baseline is told


@pytest.mark.parametrize("rotor", range(4))
def test_a_loss_of_a_tenth_is_named_within_five_seconds(rotor: int) -> None:
    rng = np.random.default_rng(rotor)
    found = named(practised(rng), rng, rotor, 0.1)
    assert found is not None
    assert found[0] <= 5.0
    assert found[1] == rotor + 1


def test_hours_of_healthy_hover_raise_no_alarm() -> None:
    rng = np.random.default_rng(3)
    watch = practised(rng)
    assert sum(alarms(watch, rng, 600) for _ in range(12)) == 0


def test_without_a_baseline_it_says_so_with_the_first_second_and_flights_become_one() -> None:
    rng = np.random.default_rng(1)
    watch = HealthWatch(PELICAN_X)
    for flight in range(ENOUGH + 1):
        reports = [watch.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 60, rng))]
        first = next(r for r in reports if r is not None)
        assert first.has_baseline == (flight >= ENOUGH)
        if flight < ENOUGH:
            assert reports[0] is first
            assert first.verdict == "unknown"
            assert f"{flight} of {ENOUGH}" in first.text
        assert watch.landed() is not None
    assert len(watch.history) == ENOUGH + 1


def test_a_damaged_or_short_flight_never_becomes_healthy_history() -> None:
    rng = np.random.default_rng(2)
    watch = practised(rng)
    before = len(watch.history)
    assert named(watch, rng, 0, 0.2) is not None
    for t, one in enumerate(hover_seconds(PELICAN_X, 20, rng)):
        watch.second(float(t), *one)
    assert watch.landed() is None
    assert len(watch.history) == before


def test_a_vehicle_that_comes_back_damaged_is_found_from_its_history() -> None:
    rng = np.random.default_rng(4)
    watch = practised(rng)
    damaged = hover_seconds(PELICAN_X, 20, rng, wrong=Wrong({3: 0.25}, {3: 0.25}))
    reports = [watch.second(float(t), *one) for t, one in enumerate(damaged)]
    alarm = next(r for r in reports if r is not None and r.verdict == "changed")
    assert alarm.t <= 5.0
    assert alarm.changes[0].parameters[0][2] == 3.0
    assert alarm.rotor_loss[2] == pytest.approx(0.25, abs=0.05)
    assert alarm.rotor_interval[2][0] < alarm.rotor_loss[2] < alarm.rotor_interval[2][1]
    assert np.isnan(alarm.mass).all(), "a rotor that lost thrust says nothing of mass"


def test_mass_is_told_by_the_thrust_of_the_baseline() -> None:
    rng = np.random.default_rng(6)
    watch = practised(rng)
    loaded = hover_seconds(PELICAN_X, 20, rng, wrong=Wrong(mass=0.15 * PELICAN_X.mass))
    reports = [r for t, one in enumerate(loaded) if (r := watch.second(float(t), *one)) is not None]
    value, low, high = reports[-1].mass
    assert low < 1.15 * PELICAN_X.mass < high
    assert value == pytest.approx(1.15 * PELICAN_X.mass, rel=0.03)
    commanded = PELICAN_X.model_copy(update={"command": Command(kind="normalized", max_speed=900.0)})
    other = HealthWatch(commanded, watch.history)
    told = [other.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 5, rng))]
    assert all(np.isnan(r.mass).all() for r in told if r is not None), "commands sag with the battery"


def test_what_differs_within_healthy_flights_is_no_change() -> None:
    rng = np.random.default_rng(7)
    watch = practised(rng)
    told = [watch.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 40, rng))]
    assert {(r.verdict, r.changes) for r in told if r is not None} == {("unchanged", ())}


def test_seconds_that_are_no_steady_flight_are_passed_over() -> None:
    watch = HealthWatch(PELICAN_X)
    load = np.full(4, 1.5e5)
    assert watch.second(1.0, load, 14.0) is None
    assert watch.second(2.0, np.array([0.0, 1.0, 1.0, 1.0]), 9.8) is None
    assert watch.airborne(load)
    assert not watch.airborne(0.2 * load)


# --- Damage hidden in both simulators is found and named; healthy pairs with other batteries and propellers are not


TENTH, FIFTH = {2: 0.1}, {3: 0.2}
BOTH = {1: 0.25, 4: 0.15}
HIDDEN = [
    Case("a tenth", TENTH, TENTH),
    Case("a fifth", FIFTH, FIFTH),
    Case("less thrust, more drag", {1: 0.12}, {1: -0.12}),
    Case("two rotors", BOTH, BOTH),
    Case("three rotors", {1: 0.3, 2: 0.2, 3: 0.15}, {1: 0.3, 2: 0.2, 3: 0.15}),
    Case("a weight beside two rotors", mass=0.15, place=(0.02, 0.12)),
    Case("a battery that slid", shift=(0.011, -0.004)),
]


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("number", range(len(HIDDEN)))
def test_hidden_damage_is_named_in_both_simulators(simulator: str, number: int) -> None:
    found = judged(HIDDEN[number], 3 * number + 1, SIMULATORS[simulator])
    assert found.changed
    assert found.right
    if len(HIDDEN[number].losses) == 1:
        assert found.loss < 0.05
        assert found.drag_loss < 0.08


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("size", [0.3, -0.3])
def test_drag_torque_alone_is_a_change_though_its_trims_name_no_rotor(simulator: str, size: float) -> None:
    assert judged(Case("thrust kept", {3: 0.0}, {3: size}), 3, SIMULATORS[simulator]).changed


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_healthy_pairs_are_unchanged_in_both_simulators(simulator: str) -> None:
    assert not any(judged(Case("healthy"), 100 + k, SIMULATORS[simulator]).changed for k in range(4))
