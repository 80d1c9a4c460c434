"""Vehicle lists of both generations: precedence, tolerance, and errors that name the field."""

from __future__ import annotations

import contextlib
import string

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import config
from crazyarena.errors import InputError

TYPES = """
crazyflieTypes:
  default:
    bigQuad: False
    batteryVoltageWarning: 3.8
    batteryVoltateCritical: 3.7
    markerConfiguration: 0
    dynamicsConfiguration: 0
    firmwareParams: {ctrlMel: {kp_xy: 0.4, mass: 0.032}, stabilizer: {controller: 1}}
  large:
    bigQuad: True
    batteryVoltageWarning: 11.4
    batteryVoltateCritical: 11.1
    markerConfiguration: 1
    dynamicsConfiguration: 0
numMarkerConfigurations: 2
markerConfigurations:
  "0": {numPoints: 2, offset: [0, 0, -0.01], points: {"0": [0.02, 0.03, 0.04], "1": [0, 0, 0]}}
  "1": {numPoints: 0, offset: [0, 0, 0], points: {}}
numDynamicsConfigurations: 1
dynamicsConfigurations:
  "0": {maxXVelocity: 2, maxYVelocity: 2, maxZVelocity: 3, maxPitchRate: 21, maxRollRate: 20,
        maxYawRate: 10, maxRoll: 1.4, maxPitch: 1.4, maxFitnessScore: 0.001}
"""
FLEET_2 = """
fileversion: 3
robots:
  cf231:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E7E7
    initial_position: [0, 0, 0]
    type: cf21
    firmware_params: {ring: {effect: 7}}
  cf5: {enabled: false, uri: radio://0/80/2M/E7E7E7E705, initial_position: [0, 0, 0], type: cf21}
  wand: {enabled: true, initial_position: [0, 0, 0], type: marker, id: 9}
  cf6:
    enabled: true
    uri: radio://1/100/2M/E7E7E7E706
    initial_position: [1, 2.5, 0]
    type: brushless
    reference_frame: stage
robot_types:
  cf21:
    connection: crazyflie
    motion_capture: {tracking: librigidbodytracker, marker: m1, dynamics: d1}
    battery: {voltage_warning: 3.9, voltage_critical: 3.6}
    firmware_params: {ring: {effect: 6}, stabilizer: {controller: 1}}
  brushless: {connection: crazyflie, big_quad: true}
  marker: {connection: none}
all:
  firmware_params: {stabilizer: {controller: 2, estimator: 2}, locSrv: {extPosStdDev: 1e-3}}
  reference_frame: world
  broadcasts: {num_repeats: 3, delay_between_repeats_ms: 2}
"""


def one(**changes):
    entry = {"id": 1, "channel": 80, "initialPosition": [0, 0, 0], "type": "default", **changes}
    return yaml.safe_dump({"crazyflies": [{k: v for k, v in entry.items() if v != "absent"}]})


class TestCrazyswarm1:
    def test_vehicle(self):
        (vehicle,) = config.load_crazyflies_1(one(id=231, initialPosition=[1, 2.5, 0])).vehicles
        assert (vehicle.id, vehicle.name, vehicle.channel) == (231, "cf231", 80)
        assert vehicle.initial_position == (1.0, 2.5, 0.0)
        assert vehicle.uri == "radio://0/80/2M/E7E7E7E7E7"

    def test_simulation_needs_only_id_and_position(self):
        text = one(channel="absent", type="absent")
        (vehicle,) = config.load_crazyflies_1(text).vehicles
        assert (vehicle.channel, vehicle.uri, vehicle.type) == (None, None, None)

    def test_path(self, tmp_path):
        path = tmp_path / "fleet.yaml"
        path.write_text(one())
        assert config.load_crazyflies_1(str(path)).source == str(path)
        assert config.load_crazyflies_1(path).vehicles[0].id == 1

    def test_precedence_of_params(self):
        types = config.load_types_1(TYPES)
        text = one(firmwareParams={"ctrlMel": {"kp_xy": "5e-1"}, "my": {"own": True}})
        params = config.load_crazyflies_1(text, types).vehicles[0].firmware_params
        assert params["ctrlMel.kp_xy"] == 0.5  # vehicle before type; text becomes a number
        assert params["ctrlMel.mass"] == 0.032
        assert params["stabilizer.controller"] == 1  # type before launch file
        assert params["stabilizer.estimator"] == 2  # launch file
        assert params["my.own"] == 1

    def test_types(self):
        types = config.load_types_1(TYPES)
        large = types.types["large"]
        assert (large.big_quad, large.battery_warning, large.battery_critical) == (True, 11.4, 11.1)
        assert types.markers["0"].points == ((0.02, 0.03, 0.04), (0.0, 0.0, 0.0))
        assert types.markers["0"].offset == (0.0, 0.0, -0.01)
        assert types.dynamics["0"].max_angular_velocity == (20.0, 21.0, 10.0)
        (vehicle,) = config.load_crazyflies_1(one(type="large"), types).vehicles
        assert (vehicle.big_quad, vehicle.marker, vehicle.battery_critical) == (True, "1", 11.1)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (one(id=256), r"crazyflies\[0\].id: found 256; expected a whole number 0..255"),
            (one(id="absent"), r"crazyflies\[0\].id: found nothing"),
            (one(id=True), r"crazyflies\[0\].id: found True"),
            (one(initialPosition=[0, 0]), r"crazyflies\[0\].initialPosition: found \[0, 0\]"),
            (one(initialPosition="absent"), r"initialPosition: found nothing; expected three"),
            (one(initialPosition=[0, "a", 0]), r"initialPosition\[1\]: found 'a'"),
            (one(channel=126), r"crazyflies\[0\].channel: found 126"),
            (one(firmwareParams={"a": {"b": "x"}}), r"firmwareParams.a.b: found 'x'"),
            (one(firmwareParams={"a": 3}), r"firmwareParams.a: found 3; expected a mapping"),
            ("crazyflies: 3", "crazyflies: found 3; expected a list"),
            ("robots: {}", "crazyflies: missing"),
            ("just some words", "found 'just some words'; expected a mapping"),
            ("a: [1", "not valid YAML"),
            (one() + one().replace("crazyflies:\n", ""), r"crazyflies\[1\]: id 1 is already used"),
        ],
    )
    def test_errors(self, text, message):
        with pytest.raises(InputError, match=message):
            config.load_crazyflies_1(text)

    def test_unknown_type(self):
        with pytest.raises(InputError, match=r"crazyflies\[0\].type: found 'x'; .* default, large"):
            config.load_crazyflies_1(one(type="x"), config.load_types_1(TYPES))

    def test_missing_file(self, tmp_path):
        with pytest.raises(InputError, match=r"none\.yaml: cannot read the crazyflies\.yaml: No"):
            config.load_crazyflies_1(tmp_path / "none.yaml")

    def test_too_few_markers(self):
        with pytest.raises(InputError, match=r"markerConfigurations\.0\.points: .* 3 points"):
            config.load_types_1(TYPES.replace("numPoints: 2", "numPoints: 3"))

    @given(st.text(alphabet=string.printable, max_size=200))
    def test_any_text_is_read_or_refused(self, text):
        with contextlib.suppress(InputError):
            config.load_crazyflies_1(text)

    @given(
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(["crazyflies", "id", "initialPosition", "robots", "type"]),
                    inner,
                    max_size=3,
                )
            ),
            max_leaves=12,
        )
    )
    def test_any_document_is_read_or_refused(self, document):
        text = yaml.safe_dump({"crazyflies": document, "robots": document})
        for load in (config.load_crazyflies_1, config.load_crazyflies_2):
            with contextlib.suppress(InputError):
                load(text)


class TestCrazyswarm2:
    def test_fleet(self):
        fleet = config.load_crazyflies_2(FLEET_2)
        a, b = fleet.vehicles
        assert (a.name, a.id, a.channel) == ("cf231", 0xE7, 80)
        assert (b.name, b.id, b.channel) == ("cf6", 6, 100)
        assert b.initial_position == (1.0, 2.5, 0.0)
        assert (fleet.broadcast_repeats, fleet.broadcast_delay) == (3, 0.002)

    def test_precedence(self):
        a, b = config.load_crazyflies_2(FLEET_2).vehicles
        assert a.firmware_params == {
            "ring.effect": 7,
            "stabilizer.controller": 1,
            "stabilizer.estimator": 2,
            "locSrv.extPosStdDev": 1e-3,
        }
        assert b.firmware_params["stabilizer.controller"] == 2
        assert (a.reference_frame, b.reference_frame) == ("world", "stage")

    def test_types(self):
        a, b = config.load_crazyflies_2(FLEET_2).vehicles
        assert (a.tracking, a.marker, a.dynamics) == ("librigidbodytracker", "m1", "d1")
        assert (a.battery_warning, a.battery_critical, a.big_quad) == (3.9, 3.6, False)
        assert (b.battery_warning, b.tracking, b.big_quad) == (3.8, None, True)

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("type: brushless", "type: x", "robots.cf6.type: found 'x'; .* cf21, brushless"),
            ("1/100/2M/E7E7E7E706", "1/80/2M/E7E7E7E7E7", "robots.cf6.uri: .* cf231 has this one"),
            ("radio://1/100/2M/E7E7E7E706", "somewhere", "robots.cf6.uri: found 'somewhere'"),
            ("enabled: false", "enabled: 3", "robots.cf5.enabled: found 3"),
            ("[1, 2.5, 0]", "[1, 2.5]", "robots.cf6.initial_position: found"),
            ("fileversion: 3", "fileversion: 7", "fileversion: found 7"),
            ("big_quad: true", "big_quad: x", "robot_types.brushless.big_quad: found 'x'"),
            ("num_repeats: 3", "num_repeats: -1", "all.broadcasts.num_repeats: found -1"),
            ("connection: none", "connection: usb", "robot_types.marker.connection: found 'usb'"),
        ],
    )
    def test_errors(self, old, new, message):
        text = FLEET_2.replace(old, new)
        assert text != FLEET_2
        with pytest.raises(InputError, match=message):
            config.load_crazyflies_2(text)
