"""Hardware in the loop: an exported policy acts 50 times a second over a socket.

The controller is a separate process with only the compiled policy. At every tick the
simulator sends an observation, waits for the action and takes a step. Needs `cc`.
"""

import ctypes
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import jaxrod

RATE = 50.0  # [Hz]
LOCAL = ("127.0.0.1", 0)  # Any port that is free.
CONTROLLER = "import sys, hardware_in_the_loop as h; h.control(*sys.argv[1:])"
SOURCE = '#include "policy.h"\nvoid act(const float*o, float*a) { policy_act(o, a); }\n'


def compiled(policy, env, folder):
    from jaxrod.training import export_c

    export_c(policy, env, folder / "policy.h")
    (folder / "policy.c").write_text(SOURCE)
    library = folder / "policy.so"
    words = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", library]
    subprocess.run([*words, folder / "policy.c", "-lm"], check=True)
    return library


def control(port, library, observation_size, action_size):
    """The controller: answers every observation until the simulator hangs up."""
    act = ctypes.CDLL(library).act
    seen = (ctypes.c_float * int(observation_size))()
    action = (ctypes.c_float * int(action_size))()
    with socket.create_connection(("127.0.0.1", int(port))) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while line.recv_into(seen, ctypes.sizeof(seen), socket.MSG_WAITALL):
            act(seen, action)
            line.sendall(action)


def simulate(env, line, seconds):
    """The simulator: latencies of the answers and delays of the ticks [s]."""
    import jax

    params, keys = env.default_params(), list(jax.random.split(jax.random.key(0), 100))
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    observation, state = reset(keys[0], params)
    action = np.zeros(env.action_size, np.float32)
    jax.block_until_ready(step(keys[0], state, action, params))  # compiles
    latencies, delays, began = [], [], time.perf_counter()
    for tick in range(1, round(seconds * RATE) + 1):
        due, key = began + tick / RATE, keys[tick % len(keys)]
        time.sleep(max(0.0, due - time.perf_counter()))
        sent = time.perf_counter()
        line.sendall(np.asarray(observation, np.float32))
        line.recv_into(action, action.nbytes, socket.MSG_WAITALL)
        latencies.append(time.perf_counter() - sent)
        delays.append(sent - due)
        observation, state, _, *ended, _ = step(key, state, action.copy(), params)
        if any(ended):
            observation, state = reset(key, params)
    return np.array(latencies), np.array(delays)


def run(policy, env, seconds):
    with tempfile.TemporaryDirectory() as name, socket.create_server(LOCAL) as door:
        library = compiled(policy, env, Path(name))
        words = [door.getsockname()[1], library, env.observation_size, env.action_size]
        words = [sys.executable, "-c", CONTROLLER, *map(str, words)]
        controller = subprocess.Popen(words, cwd=Path(__file__).parent)
        line, _ = door.accept()
        with line:
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            found = simulate(env, line, seconds)
        controller.wait(10)
        return found


def main():
    jaxrod.configure_cpu()
    from own_task import make_task

    from jaxrod.training import PPOConfig, train

    env, config = make_task(), PPOConfig(num_envs=16, rollout_steps=64)
    policy = train(env, "ppo", steps=20_000, config=config).policy
    for name, times in zip(("latency", "jitter"), run(policy, env, 10), strict=True):
        middle, high, worst = 1e6 * np.percentile(times, [50, 99, 100])
        print(f"{name} [us]: median {middle:.0f}, 99 % {high:.0f}, worst {worst:.0f}")


if __name__ == "__main__":
    main()
