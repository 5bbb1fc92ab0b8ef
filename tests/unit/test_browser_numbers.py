"""The numbers that the page in the browser reads from records of flights."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from docs.browser import image, scenes
from quad_gym.analysis.metrics import nees, state_error
from quad_gym.params.suites import sensor_suite
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, covariance_of
from quad_gym.rotations import euler_to_dcm

PAGE = Path(image.__file__).parent
NAMES = {
    r'(?:field\(\w+, |\bf\()"(\w+)"': (image.FLIGHT_FIELDS, FLIGHT_BLOCK),
    r'params\("\w+", "(\w+)"': (image.PARAMS_FIELDS, PARAMS_BLOCK),
    r'settings\("(\w+)"': (image.SETTINGS_FIELDS, SETTINGS),
}
ESTIMATE = ("r", "v", "b_a", "b_g")
NUMBERS = """
const fields = JSON.parse(process.argv[1]);
const page = Object.assign(Object.create(Simulation.prototype), {
  flights: { field: (k, name) => fields[name] },
});
const [covariance, root] = [page.covariance(0), page.positionRoot(0)];
console.log(JSON.stringify({ nees: page.nees(0), covariance, root }));
"""


def test_fields_that_scripts_read_are_fields_of_records_and_in_memory_image():
    scripts = "\n".join(file.read_text() for file in PAGE.glob("*.js"))
    for pattern, (listed, record) in NAMES.items():
        used = set(re.findall(pattern, scripts))
        assert len(used) > 2
        assert used <= set(listed) <= set(record.names)


@pytest.mark.skipif(not shutil.which("node"), reason="needs node")
def test_covariance_and_nees_of_script_equal_metrics_of_package():
    """Records hold the lower triangle; filters with a compass or camera have Euler angles."""
    assert not any(sensor_suite(s.sensors).flow_alone for s in scenes.SCENES.values())
    rng = np.random.default_rng(3)
    A = rng.normal(size=(15, 15))
    P = np.tril(A @ A.T + np.eye(15)) + np.triu(np.full((15, 15), 7.0), 1)
    fields = {f"{name}{hat}": rng.normal(size=3) for name in ESTIMATE for hat in ("", "_hat")}
    R, R_hat = euler_to_dcm([0.3, -0.2, 1.1]), euler_to_dcm([0.1, 0.15, 0.8])
    w = np.sqrt(1.0 + np.trace(R)) / 2.0
    q = [w, *((R[[1, 2, 0], [2, 0, 1]] - R[[2, 0, 1], [1, 2, 0]]) / (4.0 * w))]
    fields |= {"P": P.ravel(), "q": np.array(q), "R_hat": R_hat.ravel()}
    parts = [(PAGE / f"{name}.js").read_text() for name in ("controllers", "simulation")]
    given = json.dumps({name: value.tolist() for name, value in fields.items()})
    command = ["node", "-e", "\n".join(["const CONTROLLERS = 3;", *parts, NUMBERS]), given]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    names = ("position", "velocity", "accel_bias", "gyro_bias")
    truth = {name: fields[own] for name, own in zip(names, ESTIMATE, strict=True)}
    estimate = {name: fields[f"{own}_hat"] for name, own in zip(names, ESTIMATE, strict=True)}
    error = state_error({**truth, "R_BI": R}, {**estimate, "R_BI": R_hat})
    covariance = covariance_of(P, np.zeros(6))
    np.testing.assert_array_equal(found["covariance"], covariance)
    np.testing.assert_allclose(found["root"], np.linalg.cholesky(covariance[:3, :3]), atol=1e-12)
    assert found["nees"] == pytest.approx(nees(error, covariance), rel=1e-9)
