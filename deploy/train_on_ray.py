"""One training run on several nodes of a Ray cluster, a process on each.

``python train_on_ray.py PROCESSES [--address ADDRESS] OPTION ...``: the options are those of ``segvisrl train``. Each
process takes all GPUs of its share (``--num-devices`` says how many there are), and all see ``--runs-dir``. The output
is that of the first one, line by line.
"""

import argparse
import socket
import subprocess
import sys
from collections.abc import Iterator

import ray
from ray.util.placement_group import placement_group
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy


def address() -> str:
    """A free port of the node where this runs, where the first process is going to listen."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        return f"{ray.util.get_node_ip_address()}:{probe.getsockname()[1]}"


def train(options: list[str], coordinator: str, count: int, index: int) -> Iterator[str | int]:
    """One process: what it says, line by line, then its exit code."""
    told = ["--coordinator", coordinator, "--num-processes", str(count), "--process-id", str(index)]
    command = [sys.executable, "-u", "-m", "segvisrl_jax.cli", "train", *options, *told]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        for line in process.stdout:  # noqa: UP028  (Ray sends into its generators, which files do not understand)
            yield line
    yield process.returncode


def wait_for(answers: Iterator[ray.ObjectRef], shown: bool) -> tuple[int, str]:
    """The exit code of a process and what it said, which is printed as it comes where asked."""
    said = []
    for answer in answers:
        said.append(ray.get(answer))
        if shown and isinstance(said[-1], str):
            print(said[-1], end="", flush=True)
    return said.pop(), "".join(said)


def main() -> int:
    """Places a process on each node, and waits for all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("processes", type=int, help="how many; each gets a node of its own where there are enough")
    parser.add_argument("--address", default="auto", help="of the cluster; auto: the one that this machine belongs to")
    parser.add_argument("--cpus", type=float, default=1.0, help="what a process takes of its node")
    parser.add_argument("--gpus", type=float, default=0.0, help="likewise; give --num-devices too where it is above 1")
    asked, options = parser.parse_known_args()
    ray.init(address=asked.address, logging_level="ERROR")
    bundle = {"CPU": asked.cpus} | ({"GPU": asked.gpus} if asked.gpus else {})
    group = placement_group([bundle] * asked.processes, strategy="SPREAD")
    ray.get(group.ready())

    def on_node(index: int, work, **takes):
        where = PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=index)
        return ray.remote(work).options(scheduling_strategy=where, max_retries=0, **takes)

    coordinator = ray.get(on_node(0, address, num_cpus=0).remote())
    takes = {"num_cpus": asked.cpus, "num_gpus": asked.gpus}
    started = [
        on_node(i, train, **takes).remote(options, coordinator, asked.processes, i) for i in range(asked.processes)
    ]
    ended = [wait_for(answers, shown=i == 0) for i, answers in enumerate(started)]
    failed = [f"process {i}: exit code {code}\n{said if i else ''}" for i, (code, said) in enumerate(ended) if code]
    print("\n".join(failed), end="", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
