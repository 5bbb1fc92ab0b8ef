"""Fields of a thread's workspace, whose contents do not outlast a step."""

from quad_gym.records.enums import RewardTerm
from quad_gym.records.sizes import *

# fmt: off
WORK_FIELDS = (
    # the arguments of a stage
    Field("mask", (), "0 or 1", "lanes that the stage works on"),
    Field("start", (17,), "mixed", "true state at the start of the tick: r, v, q, w, rotor speeds"),
    # prediction
    Field("P", (MAX_STATES, MAX_STATES), "mixed", "lower triangle of the predicted covariance; then its factor"),
    Field("F", (9, 15), "mixed", "half-differences of the propagated sigma points / c; rows r, v, e"),
    Field("S", (6, 9), "mixed", "half-sums of the propagated sigma points less the center / c: of the acceleration, then e"),
    # update; the nine columns of L that matter, in reverse order; with slow errors, all columns
    Field("X_B", (MAX_FEATURES, 3), "m", "features relative to the center of mass, in B"),
    Field("inverse_distance", (MAX_FEATURES,), "1/m", "of the features from the camera"),
    Field("z_hat", (MAX_MEASUREMENTS,), "mixed", "measurement predicted at the center"),
    Field("z", (MAX_MEASUREMENTS,), "mixed", "measurement"),
    Field("nu", (MAX_MEASUREMENTS,), "mixed", "innovation; then whitened"),
    Field("A", (MAX_STATES, MAX_MEASUREMENTS), "mixed", "half-differences of the measured sigma points / c; then whitened"),
    Field("odd", (9, 3, 3), "-", "odd parts of the turns R(+-e) of the sigma points"),
    Field("even", (9, 3, 3), "-", "even parts, less the identity"),
    Field("E", (9, MAX_MEASUREMENTS), "mixed", "half-sums of the measured sigma points less the center / c"),
    Field("mu", (MAX_MEASUREMENTS,), "mixed", "mean of the measured sigma points less the center"),
    Field("Rz", (MAX_MEASUREMENTS, MAX_MEASUREMENTS), "mixed", "noise, part even in the sigma points included; then its factor"),
    Field("M", (MAX_STATES, MAX_STATES), "-", "I + C C^T; then its factor M"),
    Field("y", (MAX_STATES,), "-", "C times the whitened innovation; then M^-1 times it"),
    Field("L9", (MAX_STATES, MAX_STATES), "mixed", "the columns of L that matter; then of the updated factor"),
    Field("dx", (MAX_STATES,), "mixed", "correction of the state"),
    Field("inverse_diagonal", (MAX_MEASUREMENTS,), "mixed", "of a Cholesky factor"),
    # shared by the update and the sensors
    Field("measured", (), "-", "numbers that each lane has"),
    Field("spread", (), "-", "c of the sigma points"),
    Field("inverse_spread", (), "-", "1 / c"),
    Field("taking", (), "0 or 1", "lanes that are updated"),
    Field("again", (), "0 or 1", "lanes in a later step of the same measurements"),
    Field("judged_nis", (), "-", "sum of their NIS"),
    Field("judged_freedoms", (), "-", "sum of their degrees of freedom"),
    Field("left_out", (), "-", "numbers masked"),
    Field("along", (MAX_MEASUREMENTS,), "-", "predicted directions; zero where a block in use is none"),
    Field("suite_nis", (), "-", "sum of the NIS of the blocks in use, with the suite's noise"),
    Field("used_nis", (), "-", "this sum with the noise of the update: adapted, or of a bounded weight"),
    Field("reset", (SENSOR_GROUPS,), "0 or 1", "groups to which states are reset"),
    Field("alone", (SENSOR_GROUPS,), "0 or 1", "groups whose quantity no other accepted sensor measures"),
    Field("drifted", (), "0 or 1", "1 if the estimate has drifted gradually"),
    Field("hidden", (MAX_FEATURES,), "0 or 1", "features whose directions are too uncertain"),
    # the segment of a trajectory at an instant
    Field("path_time", (), "s", "time in the episode; then since the beginning of the segment"),
    Field("path_still", (), "0 or 1", "1 before the start and beyond the end"),
    Field("path_held", (), "0 or 1", "1 before, at and beyond the ends"),
    Field("path_terms", (TERMS, 4), "mixed", "coefficients of the segment"),
    Field("path_heading", (), "-", "rule of the heading"),
    Field("path_point", (2,), "m", "point that body x faces, in I"),
    Field("path_end", (2,), "-", "heading at the start or end"),
    # contact with the ground: four feet, then four rotor hubs
    Field("on_ground", (), "0 or 1", "lanes whose episode begins on the ground"),
    Field("ground_arm", (8, 3), "m", "vector from the center of mass, in I"),
    Field("ground_mass", (8, 3), "kg", "effective mass of a point along each axis of I: impulse over change of velocity"),
    Field("ground_impulse", (8, 3), "N s", "impulse of the ground on a point, in I"),
    Field("ground_gap", (8,), "m", "height of a point above the ground"),
    # the batch
    Field("reward_term", (len(RewardTerm),), "-", "terms of the reward of a step"),
    Field("begins", (), "0 or 1", "lanes that begin an episode"),
    Field("kind", (), "bits", "sensors with a measurement that reaches the filter"),
    Field("queued", (KINDS,), "-", "lanes of each kind that wait for an update, first number", "i8"),
    Field("source", (KINDS,), "-", "addresses of these lanes", "u8"),
    Field("source_block", (KINDS,), "-", "addresses of the blocks of these lanes", "u8"),
    Field("observation", (MAX_OBSERVATION,), "mixed", "observation of the present instant"),
    # delayed measurements
    Field("arrives", (DELAY_SLOTS,), "0 or 1", "1 for the measurement in transit that arrives now"),
    Field("arrived", (MAX_BLOCKS, 3), "mixed", "last measurements that arrived, stored while new ones are taken"),
    # the estimate before a late update
    Field("kept_r_hat", (3,), "m", "r_hat"),
    Field("kept_v_hat", (3,), "m/s", "v_hat"),
    Field("kept_v_corrected", (3,), "m/s", "v_corrected"),
    Field("kept_R_hat", (3, 3), "-", "R_hat"),
    Field("kept_b_a_hat", (3,), "m/s^2", "b_a_hat"),
    Field("kept_b_g_hat", (3,), "rad/s", "b_g_hat"),
    Field("kept_L", (15, 15), "mixed", "L"),
    Field("kept_slow_hat", (MAX_SLOW,), "mixed", "slow_hat"),
    Field("kept_L_slow", (MAX_SLOW, MAX_STATES), "mixed", "L_slow"),
    Field("kept_block_valid", (MAX_BLOCKS,), "0 or 1", "measured blocks"),
    Field("kept_w_meas", (3,), "rad/s", "w_meas"),
    Field("kept_update_failures", (), "-", "update_failures"),
    # the instant to which a late update goes back
    Field("slow_decay", (MAX_SLOW,), "-", "decay of the slow errors since then"),
    Field("since_time", (), "s", "T since then"),
    Field("since_turn", (3, 3), "-", "C of then"),
    Field("since_velocity", (3,), "m/s", "V of then"),
    Field("since_position", (3,), "m", "X of then"),
    Field("since_bias_gain", (3, 3), "s", "B_s, gain of the biases since then"),
    Field("since_noise", (), "0 or 1", "1 if the noise since then was removed"),
    Field("columns", (15, 21), "mixed", "L and six columns of noise, taken back or on"),
)
# fmt: on
