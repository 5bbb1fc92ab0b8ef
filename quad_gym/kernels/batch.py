"""The one entry that flies: a step, or a reset, of a range of blocks."""

from quad_gym.kernels.blocks import lanes_of
from quad_gym.kernels.compilation import entry, kernel
from quad_gym.kernels.draws import impose
from quad_gym.kernels.faults import meet_rotors
from quad_gym.kernels.flight import begin_episode, tick
from quad_gym.kernels.judge import judge
from quad_gym.kernels.lanes import any_of, logical_not, select
from quad_gym.kernels.observe import observe
from quad_gym.records import WIDTH, Autoreset, Command


@kernel
def _write_rows(source, low, high, out, block, mask):
    """Copy observations from lanes to the rows of an array, held within the space's bounds."""
    first = block * WIDTH
    for lane in range(min(WIDTH, out.shape[0] - first)):
        if mask[lane] > 0.0:
            for k in range(out.shape[1]):
                value = source[k, lane]
                value = value if value > low[k] else low[k]
                out[first + lane, k] = value if value < high[k] else high[k]


@kernel
def _load_actions(block, actions, index):
    """Make the caller's actions the present ones, and the present ones the last."""
    first = index * WIDTH
    for i in range(4):
        for lane in range(WIDTH):
            block.last_action[i, lane] = block.action[i, lane]
            known = first + lane < actions.shape[0]
            block.action[i, lane] = actions[first + lane, i] if known else 0.0


@kernel
def _write_results(block, results, index):
    """What the caller wants to know of a step, before a new episode overwrites it."""
    first = index * WIDTH
    for lane in range(min(WIDTH, results.shape[0] - first)):
        row = results[first + lane]
        row[0] = block.reward[lane]
        row[1] = block.terminated[lane]
        row[2] = block.truncated[lane]
        row[3] = block.ending[lane]
        row[4] = block.position_error[lane]
        row[5] = block.estimation_error[lane]
        row[6] = block.filter_status[lane]
        row[7] = block.step[lane]
        row[8] = block.episode_return[lane]
        row[9] = block.episode_error[lane]
        row[10] = block.gate_next[lane]
        row[11] = block.faults[lane]


@kernel
def _fly_step(flight, world, model, settings, work):
    """Fly a control period and judge it; return which lanes begin and which ended an episode."""
    resetting = (flight.needs_reset > 0.0) & (settings.autoreset == Autoreset.NEXT_STEP)
    flight.position_fresh = 0.0
    flight.baseline_fresh = 0.0
    for i in range(settings.feature_count):
        flight.feature_fresh[i] = 0.0
    instant = flight.instant
    for _ in range(settings.ticks_per_step):
        tick(flight, world, model, settings, work)
    # a step that begins an episode draws nothing before it
    flight.instant = select(resetting, instant, flight.instant)
    judge(flight, model, settings, logical_not(resetting))
    done = (flight.terminated + flight.truncated) > 0.0
    flight.needs_reset = select(done, 1.0, flight.needs_reset)
    same_step = settings.autoreset == Autoreset.SAME_STEP
    return resetting | (done & (same_step | (flight.idle > 0.0))), done


@entry
def fly(
    blocks,
    first_block,
    last_block,
    command,
    resets,
    world,
    own,
    model,
    settings,
    work,
    actions,
    low,
    high,
    observations,
    final_observations,
    results,
):
    """Step or reset the flights of a range of blocks.

    Args:
        blocks: (n_blocks,) FLIGHT_BLOCK.
        first_block, last_block: The range, without its end.
        command: A `Command`.
        resets: (n,) uint8; for RESET, which flights begin an episode.
        world: (1,) PARAMS_BLOCK: parameters as they are.
        own: (1,) PARAMS_BLOCK, used by no other thread: a copy of `world`, where the parameters of
            the flights at hand are put together if they draw some, or if their rotors can fail.
        model: (1,) PARAMS_BLOCK: parameters as the filter and the controller believe them.
        settings: (1,) SETTINGS.
        work: (1,) WORK_BLOCK, used by no other thread.
        actions: (n, 4); for STEP.
        low, high: (n_observation,) bounds of the observation space.
        observations: (n, n_observation), written; with no columns nothing is observed.
        final_observations: Likewise, written where one episode ends and the next begins in this
            step.
        results: (n, 12), written in a STEP: see `quad_gym.records.RESULTS`.
    """
    scratch, todo, nominal = lanes_of(work[0]), settings[0], lanes_of(world[0])
    differ = todo.randomized > 0 or todo.faults > 0
    true = lanes_of(own[0]) if differ else nominal
    believed = true if todo.known else lanes_of(model[0])
    observing = observations.shape[1] > 0
    for index in range(first_block, last_block):
        block, flight = blocks[index], lanes_of(blocks[index])
        if todo.randomized:
            impose(flight, nominal, true, todo)
        if todo.faults:
            meet_rotors(flight, true, todo)
        if command == Command.RESET:
            for lane in range(WIDTH):
                known = index * WIDTH + lane < resets.shape[0]
                work[0].begins[lane] = resets[index * WIDTH + lane] if known else 1.0
            begins = scratch.begins > 0.0
        else:
            _load_actions(block, actions, index)
            begins, done = _fly_step(flight, true, believed, todo, scratch)
            _write_results(block, results, index)
            if observing:
                observe(flight, believed, todo, scratch.observation)
                scratch.begins = select(begins & done, 1.0, 0.0)
                _write_rows(
                    work[0].observation, low, high, final_observations, index, work[0].begins
                )
        beginning = any_of(begins)
        if beginning:
            begin_episode(flight, nominal, true, believed, todo, scratch, begins)
        if observing:
            if beginning or command == Command.RESET:
                observe(flight, believed, todo, scratch.observation)
            scratch.begins = select(flight.tick >= 0.0, 1.0, 0.0)
            _write_rows(work[0].observation, low, high, observations, index, work[0].begins)
