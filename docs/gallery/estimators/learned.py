"""A learned estimator: dead reckoning, corrected at each GNSS fix with the gains of a GRU.

The IMU is integrated. At a fix, the residuals of position, velocity and heading are multiplied by
a gain, which a recurrent network returns, together with the standard deviations of the errors: the
form of KalmanNet. Nothing models noise and biases; the network learns them from logged flights, by
back-propagation through the integration, in a minute on one core:

    cd docs/gallery/estimators
    python learned.py  # with PyTorch; writes learned.npz
    quad-gym evaluate --policy pd --sensors rtk --estimator learned:Learned

The included weights are for `rtk`. They do not use the camera, and are valid for the noise, the
rates and the motions of their logs only, without outages or faults; between fixes the standard
deviations do not grow.

Source: G. Revach and others, KalmanNet, IEEE Trans. Signal Processing 70, 2022.
"""

from pathlib import Path

import numpy as np

import quad_gym
from quad_gym.analysis.consistency import endless
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import Source
from quad_gym.rotations import euler_to_dcm

FILE, SIZE = Path(__file__).with_name("learned.npz"), 32  # of the memory h
READINGS = ("gnss_position", "gnss_velocity", "gnss_baseline")
RESIDUALS = np.repeat([0.05, 0.1, 0.03], [3, 3, 1])  # usual sizes [m, m/s, rad]
STATES = np.repeat([0.02, 0.05, 0.005, 0.01, 0.0005], 3)  # of errors of r, v, e, b_a and b_g


def apply(A, x):
    """A x of stacked matrices and vectors."""
    return (A @ x[..., None])[..., 0]


def turned(xp, R, x):
    """R_BI after a small rotation x in B, to second order; xp is numpy or torch."""
    (a, b, c), o = (x[:, k] for k in range(3)), 0.0 * x[:, 0]
    rows = [o, -c, b], [c, o, -a], [-b, a, o]
    A = xp.stack([xp.stack(row, -1) for row in rows], -2) @ R
    return R - A + 0.5 * A @ R.swapaxes(1, 2) @ A


def correct(xp, W, state, fix, T, gyro):
    """The state and the standard deviations of its errors after a fix; xp is numpy or torch.

    The state is r, v, R_BI, b_a, b_g, the memory h, and the velocity after the fix before, T ago.
    """
    r, v, R, b_a, b_g, h, v_0 = state
    a, age = (v - v_0) / T, W["age"]
    R_IB = turned(xp, R, -age * (gyro - b_g)).swapaxes(1, 2)  # at the time stamp
    d_r = fix[0] - (r - age * v + age**2 / 2.0 * a + R_IB @ W["antenna"])
    d_v = fix[1] - (v - age * a)
    b_I = R_IB @ W["baseline"]
    turn = b_I[:, :1] * fix[2][:, 1:2] - b_I[:, 1:2] * fix[2][:, :1]
    d = xp.concatenate([d_r, d_v, turn / (W["baseline"] ** 2).sum()], -1) / W["residuals"]
    x = xp.concatenate([xp.arcsinh(d), a / 10.0], -1)
    gates = 0.5 + 0.5 * xp.tanh(xp.concatenate([x, h], -1) @ W["gates"] + W["gates_0"])
    forget, keep = gates[:, :SIZE], gates[:, SIZE:]
    new = xp.tanh(xp.concatenate([x, forget * h], -1) @ W["new"] + W["new_0"])
    h = keep * h + (1.0 - keep) * new
    out = h @ W["out"] + W["out_0"]
    dx = W["states"] * apply(out[:, :105].reshape(-1, 15, 7), d)
    sigma = W["states"][:9] * xp.exp(out[:, 105:])
    r, v, R = r + dx[:, :3], v + dx[:, 3:6], turned(xp, R, apply(R, dx[:, 6:9]))
    b_a, b_g = b_a + apply(R, dx[:, 9:12]), b_g + apply(R, dx[:, 12:])
    return (r, v, R, b_a, b_g, h, v), sigma


class Learned(quad_gym.Estimator):
    state = {
        "r": np.zeros(3),
        "v": np.zeros(3),
        "R": np.eye(3),
        "b_a": np.zeros(3),
        "b_g": np.zeros(3),
        "h": np.zeros(SIZE),
        "v_0": np.zeros(3),
        "T": 0.0,
        "sigma": np.ones(15),
    }

    def __init__(self, weights=FILE):
        self.weights = dict(np.load(weights))

    def reset(self, view, mask):
        if view.gnss_velocity is None or view.gnss_baseline is None:
            raise ValueError("Learned needs sensors with GNSS velocities and a baseline")
        s = self.state
        s.r, s.v, s.R, s.v_0 = view.position, view.velocity, view.R_BI, view.velocity
        s.sigma = np.sqrt(np.einsum("nii->ni", view.covariance))

    def update(self, m):
        s, new = self.state, m.gnss_position.new
        step = increment(m.gyro - s.b_g, m.accel - s.b_a, m.dt)
        s.r, s.v, s.R = moved(np, (s.r, s.v, s.R), step, m.dt, m.vehicle.gravity)
        s.T += m.dt
        if new.any():
            names = ("r", "v", "R", "b_a", "b_g", "h", "v_0")
            state = [getattr(s, name)[new] for name in names]
            fix = [getattr(m, name).value[new] for name in READINGS]
            state, sigma = correct(np, self.weights, state, fix, s.T[new, None], m.gyro[new])
            for name, values in zip(names, state, strict=True):
                getattr(s, name)[new] = values
            s.sigma[new, :9], s.T[new] = sigma, 0.0
        return {
            "position": s.r,
            "velocity": s.v,
            "R_BI": s.R,
            "accel_bias": s.b_a,
            "gyro_bias": s.b_g,
            "covariance": s.sigma[:, :, None] ** 2 * np.eye(15),
        }


def increment(gyro, accel, dt, before=None):
    """Rotation, and velocity and position without gravity, that samples add in an earlier B."""
    eye, zero = np.tile(np.eye(3), (len(gyro), 1, 1)), np.zeros_like(gyro)
    turn, dv, dr = before or (eye, zero, zero)
    half = euler_to_dcm(dt / 2.0 * gyro) @ turn
    a = apply(half.swapaxes(1, 2), accel)
    return euler_to_dcm(dt * gyro) @ turn, dv + dt * a, dr + dt * dv + dt**2 / 2.0 * a


def moved(xp, pose, increment, T, gravity=9.80665):
    """Position, velocity and attitude after an increment of a time T."""
    (r, v, R), (turn, dv, dr) = pose, increment
    R_IB, fall = R.swapaxes(1, 2), xp.zeros_like(v)
    fall[:, 2:] = gravity * T
    return r + T * v + apply(R_IB, dr) - T / 2.0 * fall, v + apply(R_IB, dv) - fall, turn @ R


def logged(suite, flights, seconds, seed=1_000_000):
    """Start, and for each fix the time before it, increment, fix, gyro and true state."""
    batch = quad_gym.FlightBatch(
        flights,
        sensors=suite.replace(gnss=suite.gnss.replace(phase=0.0)),  # all at the same instants
        task=endless(TASK_DEFAULTS["random_trajectory"]),
        gains="tuned",
        source=Source.TRUTH,
        run_filter=True,
    )
    batch.reset(seeds=range(seed, seed + flights))
    names, rows, step = ("position", "velocity", "R_BI"), [], None
    start, T = [batch.read(f"estimated_{name}") for name in names], 0.0
    for _ in range(round(seconds / suite.imu.dt)):
        batch.step()
        gyro = batch.read("gyro")
        step = increment(gyro, batch.read("accel"), suite.imu.dt, step)
        T += suite.imu.dt
        fix = [batch.read(name) for name in READINGS]
        if np.isfinite(fix[0]).all():
            rows.append((np.full((flights, 1), T), *step, *fix, gyro, *map(batch.read, names)))
            step, T = None, 0.0
    return start, [np.array(column) for column in zip(*rows, strict=True)]


def train(suite, flights=512, seconds=8.0, steps=200, batch=128, rate=1e-2, report=print):
    """Weights by name, from flights that are logged first."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    inputs, gnss = 10 + SIZE, suite.gnss
    given = {"age": gnss.latency, "antenna": gnss.primary_antenna_B, "baseline": gnss.baseline_B}
    W = given | {"residuals": RESIDUALS, "states": STATES}
    W = {name: torch.tensor(np.array(value), dtype=torch.float32) for name, value in W.items()}
    for name, n, k in [("gates", inputs, 2 * SIZE), ("new", inputs, SIZE), ("out", SIZE, 114)]:
        W[name] = (0.0 if name == "out" else n**-0.5) * torch.randn(n, k)
        W[f"{name}_0"] = torch.zeros(k)
    W["out_0"][105:] = 2.0
    learned = [W[name].requires_grad_() for name in list(W)[-6:]]
    logs = logged(suite, flights, seconds)
    (r, v, R), rows = ([torch.tensor(x, dtype=torch.float32) for x in part] for part in logs)
    optimizer = torch.optim.Adam(learned, lr=rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps)
    for step in range(steps):
        some, loss = torch.randperm(flights)[:batch], 0.0
        zero = torch.zeros(len(some), 3)
        state = (r[some], v[some], R[some], zero, zero, torch.zeros(len(some), SIZE), v[some])
        for row in zip(*rows, strict=True):
            T, turn, dv, dr, *fix, gyro, r_k, v_k, R_k = (x[some] for x in row)
            _, before, _, b_a, b_g, h, _ = state
            dr, dv = dr - T**2 / 2.0 * b_a, dv - T * b_a
            pose = moved(torch, state[:3], (turn, dv, dr), T)
            pose = (*pose[:2], turned(torch, pose[2], -T * b_g))
            state, sigma = correct(torch, W, (*pose, b_a, b_g, h, before), fix, T, gyro)
            A = (R_k @ state[2].mT - state[2] @ R_k.mT) / 2.0  # -[e x]
            e = torch.stack([A[:, 1, 2], A[:, 2, 0], A[:, 0, 1]], -1)
            error = torch.concatenate([r_k - state[0], v_k - state[1], e], -1)
            square = (
                error / sigma
            ) ** 2  # at first a likelihood with heavy tails, then a normal one
            square = 10.0 * torch.log1p(square / 9.0) if step < steps // 2 else square
            loss = loss + (torch.log(sigma) + square / 2.0).mean()
        loss = loss / len(rows[0])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learned, 1.0)
        optimizer.step()
        schedule.step()
        if step % 20 == 0:
            report(f"step {step}: loss {float(loss.detach()):.3f}")
    return {name: value.detach().numpy() for name, value in W.items()}


if __name__ == "__main__":
    np.savez_compressed(FILE, **train(quad_gym.sensor_suite("rtk")))
