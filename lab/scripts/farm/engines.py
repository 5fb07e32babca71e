"""The bars of `entire farm` that need engines: runs on real HyperQueue and Slurm, kills at random moments, full disks.

Prints what it measures and one line `bar NAME VALUE LIMIT ok|short` per bar; ends with status 1 when one is short.

    python3 lab/scripts/farm/engines.py --bin target/release --python VENV/bin/python --out out/farm-bars PART…

Parts: hq-frames, hq-sleeping, slurm, kills, full. Missing programs are reported, and the bars of their engine are
short.

The makespan of a run is divided by the least possible makespan: the lower bound of its measured task times plus the
overhead that the engine cannot avoid. This overhead is one start of the engine (measured with a job of one task) and,
on every slot, the time from the end of a bundle to the start of the next one (measured with a job of short bundles that
keep all slots busy). Both are minima over REPEATS measurements. If a run takes less than the least possible makespan,
the overhead was measured too high. The run is then compared with the lower bound of its task times alone, which is
stricter."""

import argparse
import csv
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bar_lines import Bars  # noqa: E402

ASKED = {
    "hq-frames": {"farm-hyperqueue-frames-of-bound-and-overhead": 1.05},
    "hq-sleeping": {"farm-hyperqueue-sleeping-of-bound": 1.04},
    "slurm": {"farm-slurm-of-bound-and-overhead": 1.10},
    "kills": {"farm-kills-lost-or-wrong": 0},
    "full": {"farm-full-disk-lost-or-wrong": 0},
}
# Number of tasks per slot, and number of repeats, of the jobs that measure an engine's overhead.
ROUNDS = 16
REPEATS = 3
# Number of runs with killed processes that the bar needs.
RUNS = 20


def lower_bound(times, slots):
    """Returns a lower bound of the makespan for every order of the tasks: the larger of the sum of their times divided
    by the number of slots, and the longest time."""
    return max(sum(times) / slots, max(times))


# Volumes that no shipped model was trained on.
HELD_OUT = ["castro_blast/m04/t0012", "castro_blast/m05/t0012", "maestroex_bubbles/m03/t0010", "maestroex_bubbles/m03/t0015",
            "nyx_cosmology/m04/t0010", "mr_banana"]


# Renderer of a job file.
CPU = '[renderer]\nkind = "entire"\ndevice = "cpu"\n'


class Farm:
    def __init__(self, options):
        self.entire = Path(options.bin).resolve() / "entire"
        self.lab = Path(options.bin).resolve() / "entire-lab"
        self.python = options.python
        self.out = Path(options.out).resolve()
        self.root = Path(__file__).resolve().parents[3]

    def job(self, name, renderer, volumes, views, size, predict="", steps="1.0"):
        """Writes a job file; the database of an earlier run is removed."""
        folder = self.out / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        entries = "".join(
            f'[[volumes]]\nname = "{v.parent.parent.name}-{v.parent.name}-{v.stem}"\nfiles = ["{v}"]\n' for v in volumes
        )
        text = f"""name = "db"
sizes = ["{size}"]
steps = [{steps}]
{entries}[[cameras]]
kind = "orbit"
views = {views}
elevation_deg = 20.0
distances_radii = [2.0]
[[transfer]]
name = "one"
lobes = [[0.5, 0.05, 0.2], [0.8, 0.02, 0.5]]
{renderer}
{predict}"""
        file = folder / "job.toml"
        file.write_text(text)
        return file

    def run(self, job, *arguments, check=True):
        command = [str(self.entire), "farm", str(job), "--quiet", *arguments]
        done = subprocess.run(command, capture_output=True, text=True)
        if check and done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
        return done

    def journal(self, job):
        lines = (job.parent / "db.cdb/.farm/journal.jsonl").read_text().splitlines()
        entries = [json.loads(line) for line in lines]
        done = [e["done"]["answer"] for e in entries if "done" in e]
        begin = next(e["run"]["at"] for e in reversed(entries) if "run" in e)
        return begin, done

    def measure(self, job):
        """Returns the makespan since the engine's start, the seconds of each task with loading, and the number of
        bundles."""
        begin, done = self.journal(job)
        end = max(a["end"] for a in done)
        return end - begin, [a["seconds"] + a["load_s"] for a in done], len({a["bundle"] for a in done})

    def turns(self, job, slots):
        """Returns the seconds from the engine's start to the first task, and the mean seconds on a slot from a bundle's
        end to the next bundle's start; None instead of the mean if no bundle followed another."""
        begin, done = self.journal(job)
        begins, ends = {}, {}
        for a in done:
            begins[a["bundle"]] = min(a["begin"], begins.get(a["bundle"], a["begin"]))
            ends[a["bundle"]] = max(a["end"], ends.get(a["bundle"], a["end"]))
        # The slot of a bundle is unknown: each start after the first start on every slot is paired with the earliest
        # unpaired end.
        followed = list(zip(sorted(begins.values())[slots:], sorted(ends.values())))
        turn = sum(b - e for b, e in followed) / len(followed) if followed else None
        return min(begins.values()) - begin, turn

    def recorded(self, job, frames):
        """Writes a task list that assigns recorded times (predicted, measured) to the job's task ids; returns its
        path."""
        rows = self.ids(job)
        times = job.parent / "times.csv"
        with times.open("w") as file:
            table = csv.writer(file)
            table.writerow(["task", "predicted_s", "measured_s", "volume", "load_s"])
            for i, row in enumerate(rows):
                table.writerow([row["task"], *frames[i % len(frames)], row["volume"], 0])
        return times

    def ids(self, job):
        """Returns the rows of a job's tasks (id, predicted seconds and so on), in the order of the job."""
        file = job.parent / "ids.csv"
        self.run(job, "--dry-run", "--save-tasks", str(file))
        return list(csv.DictReader(file.open()))

    def sleeping(self, name, engine, slots, frames, order="longest", views=64, volumes=6):
        """Runs `views` × `volumes` tasks on an engine; each sleeps for a recorded time. Returns the results of
        `measure`, and the path of the task list."""
        volumes = sorted((self.root / "data").glob("*/*/*.nrrd"))[:volumes]
        times = self.out / name / "times.csv"
        command = json.dumps([str(self.lab), "farm-stand-in", str(times)])
        renderer = f'[renderer]\nkind = "session"\ncommand = {command}\n'
        job = self.job(name, renderer, volumes, views, "8x8")
        self.recorded(job, frames)
        told = job.parent / "told.toml"
        told.write_text(job.read_text() + '\n[predict]\nlist = "times.csv"\n')
        self.run(told, *engine, "--slots", str(slots), "--order", order)
        return (*self.measure(told), times)

    def hyperqueue(self):
        return ["--engine", "hyperqueue", "--python", self.python]

    def simulate(self, times, slots, latency, *arguments):
        command = [str(self.lab), "farm-simulate", str(times), "--slots", str(slots), "--latency", str(latency)]
        return json.loads(subprocess.run([*command, *arguments], capture_output=True, text=True, check=True).stdout)


def frames_of(farm, mean):
    """Returns predicted and measured seconds of 384 frames of six volumes, which are rendered here and predicted by a
    shipped model. The times are scaled so that the mean measured time is `mean`."""
    file = farm.out / "recorded.json"
    if not file.exists():
        record(farm)
    found = json.loads(file.read_text())
    factor = mean * len(found) / sum(m for _, m in found)
    return [(p * factor, m * factor) for p, m in found]


def paper_case(farm, name, size, device, predict=""):
    """Writes the job of six volumes that no shipped model was trained on, with 64 views each; returns its file."""
    volumes = [farm.root / "data" / f"{volume}.nrrd" for volume in HELD_OUT]
    return farm.job(name, CPU.replace("cpu", device), volumes, 64, size, predict)


def record(farm):
    """Renders the job of `paper_case`, one processor per frame, and writes predicted and measured times to
    recorded.json."""
    os.environ["LP_NUM_THREADS"] = "1"
    model = f'[predict]\nmodel = "{farm.root}/models/unshaded-selected.safetensors"\n'
    job = paper_case(farm, "recorded", "384x384", "auto", model)
    predicted = farm.ids(job)
    farm.run(job, "--slots", str(os.cpu_count()))
    measured = {a["task"]: a["render_s"] for a in farm.journal(job)[1]}
    frames = [(float(row["predicted_s"]), measured[row["task"]]) for row in predicted]
    (farm.out / "recorded.json").write_text(json.dumps(frames))
    ratios = sorted(p / m for p, m in frames)
    middle = ratios[len(ratios) // 2]
    errors = sorted(abs(r / middle - 1) for r in ratios)
    print(f"recorded: {len(frames)} frames, {sum(m for _, m in frames):.1f} s in all; predicted / measured: median {middle:.3f}, "
          f"median deviation from it {100 * errors[len(errors) // 2]:.1f} %", flush=True)


def overhead(farm, run, slots):
    """Returns the seconds of an engine's start, and the seconds on a slot from a bundle's end to the next bundle's
    start. `run(tasks)` runs a job of `tasks` short tasks, in bundles as small as possible, and returns the job's
    file."""
    starts, turns = [], []
    for _ in range(REPEATS):
        starts.append(farm.turns(run(1), slots)[0])
        turns.append(farm.turns(run(ROUNDS * slots), slots)[1])
    return max(0.0, min(starts)), max(0.0, min(turns))


def over_bound(bars, name, what, run, slots, cost):
    """Prints the bar of a run: its makespan divided by the least possible makespan (see the top of this file)."""
    (makespan, times, bundles), (start, turn) = run, cost
    bound = lower_bound(times, slots)
    least = start + max(sum(times) / slots + max(0.0, bundles / slots - 1) * turn, max(times))
    print(f"{what}: {makespan:.3f} s; lower bound {bound:.3f} s of the tasks alone, {least:.3f} s with a start of {start:.3f} s "
          f"and {1e3 * turn:.1f} ms between {bundles} bundles; {makespan / bound:.4f} of the bound of the tasks alone", flush=True)
    if makespan < least:
        print(f"the overhead was measured too high: with it, a run takes at least {least:.3f} s, but this run took {makespan:.3f} s. "
              "The bar ignores the overhead; measure again on a quiet machine", flush=True)
        bars.found(name, makespan / bound, "divided by the lower bound of the tasks alone")
    else:
        bars.found(name, makespan / least)


def hq_frames(farm, bars):
    slots = os.cpu_count()

    def run(tasks):
        job = farm.job("hq-short", CPU, [farm.root / "data" / f"{HELD_OUT[0]}.nrrd"], tasks, "256x256")
        farm.run(job, *farm.hyperqueue(), "--slots", str(slots), "--overhead", "0")
        return job

    cost = overhead(farm, run, slots)
    job = paper_case(farm, "hq-frames", "256x256", "cpu")
    farm.run(job, *farm.hyperqueue(), "--slots", str(slots))
    over_bound(bars, "farm-hyperqueue-frames-of-bound-and-overhead", f"hyperqueue, 384 real frames, {slots} workers",
               farm.measure(job), slots, cost)


def hq_sleeping(farm, bars):
    slots = 64
    frames = frames_of(farm, 10.0)
    seconds = [m for _, m in frames]
    found = {}
    for order in ["arrival", "uniform", "longest"]:
        makespan, times, bundles, table = farm.sleeping(f"hq-{order}", farm.hyperqueue(), slots, frames, order)
        found[order] = makespan
        bound = lower_bound(seconds, slots)
        print(f"hyperqueue, {len(times)} sleeping tasks, {slots} workers, {order}: {makespan:.3f} s, bound {bound:.3f} s, "
              f"{makespan / bound:.4f}, {bundles} bundles", flush=True)
    # The simulator's latency is fitted to the run in arrival order and tested on the runs in the other orders.
    low, high = 0.0, 2.0
    for _ in range(30):
        middle = (low + high) / 2
        got = farm.simulate(table, slots, middle, "--arrival")["makespan_s"]
        low, high = (middle, high) if got < found["arrival"] else (low, middle)
    worst = 0.0
    for order, options in [("longest", []), ("uniform", ["--uniform"])]:
        got = farm.simulate(table, slots, low, *options)["makespan_s"]
        worst = max(worst, abs(got / found[order] - 1))
        print(f"simulator, latency {1e3 * low:.1f} ms a bundle: {order} {got:.3f} s, the engine {found[order]:.3f} s", flush=True)
    print(f"simulator against hyperqueue: error at most {100 * worst:.1f} %", flush=True)
    bars.found("farm-hyperqueue-sleeping-of-bound", found["longest"] / lower_bound(seconds, slots))


def slurm(farm, bars):
    folder = farm.out / "slurm"
    shutil.rmtree(folder, ignore_errors=True)
    script = Path(__file__).with_name("slurm.sh")
    started = subprocess.run([str(script), "start", str(folder)], capture_output=True, text=True)
    if started.returncode:
        bars.lacking(started.stderr.strip(), ASKED["slurm"])
        return
    os.environ["SLURM_CONF"] = started.stdout.strip()
    try:
        engine = ["--engine", "slurm"]

        def short(tasks):
            # A task of 0.5 s is long enough for the next bundles to reach Slurm's queue.
            farm.sleeping("slurm-short", [*engine, "--overhead", "0"], 4, [(0.5, 0.5)], views=tasks, volumes=1)
            return farm.out / "slurm-short/told.toml"

        cost = overhead(farm, short, 4)
        *run, table = farm.sleeping("slurm-sleeping", engine, 4, frames_of(farm, 0.5))
        got = farm.simulate(table, 4, cost[1], "--overhead", str(cost[1]))["makespan_s"]
        print(f"simulator against slurm: {got:.3f} s, error {100 * abs(got / run[0] - 1):.1f} %", flush=True)
        over_bound(bars, "farm-slurm-of-bound-and-overhead", "slurm, 384 sleeping tasks, 4 nodes", run, 4, cost)
    finally:
        subprocess.run([str(script), "stop", str(folder)])


def pictures(job):
    folder = job.parent / "db.cdb/image"
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.glob("*/*.png")}


def descendants(pid):
    found = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True).stdout
    parent = {int(a): int(b) for a, b in (line.split() for line in found.splitlines())}
    out, grown = {pid}, True
    while grown:
        more = {p for p, of in parent.items() if of in out} - out
        grown = bool(more)
        out |= more
    return out - {pid}


def kills(farm, bars, runs):
    if runs < RUNS:
        bars.lacking(f"{runs} runs are fewer than the {RUNS} that the bar needs (--runs {RUNS})", ASKED["kills"])
        return
    volumes = sorted((farm.root / "data").glob("*/*/*.nrrd"))[:3]
    reference = farm.job("kill-reference", CPU, volumes, 40, "48x48")
    farm.run(reference, "--slots", "2")
    right = pictures(reference)
    draw = random.Random(11)
    lost = wrong = killed = twice = 0
    for run in range(runs):
        engine = farm.hyperqueue() if run % 2 else []
        job = farm.job(f"kill-{run}", CPU, volumes, 40, "48x48")
        begun = job.parent / "db.cdb/.farm/journal.jsonl"
        for _ in range(12):
            more = ["--resume"] if begun.exists() and begun.stat().st_size else []
            command = [str(farm.entire), "farm", str(job), "--quiet", "--slots", "2", *engine, *more]
            driver = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            # Kills some workers or the engine at random moments, then the driver itself.
            until = time.time() + draw.uniform(0.2, 1.2)
            while driver.poll() is None and time.time() < until:
                time.sleep(draw.uniform(0.02, 0.3))
                below = sorted(descendants(driver.pid))
                if below and draw.random() < 0.7:
                    try:
                        os.kill(draw.choice(below), signal.SIGKILL)
                        killed += 1
                    except ProcessLookupError:
                        pass
            if driver.poll() is None:
                driver.kill()
                killed += 1
            if driver.wait() == 0:
                break
        farm.run(job, "--slots", "2", "--resume", "--retry-quarantined", *engine)
        found = pictures(job)
        lost += len(right.keys() - found.keys())
        wrong += sum(1 for name in found if right.get(name) != found[name])
        done = [e["task"] for e in farm.journal(job)[1]]
        twice += len(done) - len(set(done))
        rows = sum(1 for _ in (job.parent / "db.cdb/data.csv").open()) - 1
        lost += len(right) - rows
    print(f"kills: {runs} runs of {len(right)} images, {killed} processes killed, {lost} images lost, {wrong} wrong, {twice} "
          "recorded twice", flush=True)
    bars.found("farm-kills-lost-or-wrong", lost + wrong if killed and right else None)


def full(farm, bars):
    """Runs a job on a disk that becomes full, then makes the disk larger and resumes the job."""
    folder = farm.out / "full-disk"
    folder.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o"]
    if subprocess.run([*mount, "size=400k", "tmpfs", str(folder)], capture_output=True).returncode:
        bars.lacking("only root can mount a small disk: run this as root", ASKED["full"])
        return
    try:
        volumes = sorted((farm.root / "data").glob("*/*/*.nrrd"))[:2]
        reference = farm.job("full-reference", CPU, volumes, 40, "96x96")
        farm.run(reference, "--slots", "2")
        right = pictures(reference)
        job = folder / "job.toml"
        job.write_text(reference.read_text())
        ended = farm.run(job, "--slots", "2", check=False)
        before = len(pictures(job))
        print(f"full: {before} of {len(right)} images, then: {ended.stderr.strip()}", flush=True)
        told = ended.returncode == 1 and "--resume" in ended.stderr and before < len(right)
        subprocess.run([*mount, "remount,size=64m", "tmpfs", str(folder)], check=True)
        farm.run(job, "--slots", "2", "--resume")
        found = pictures(job)
        bad = sum(1 for name in right if right[name] != found.get(name))
        if told:
            bars.found("farm-full-disk-lost-or-wrong", bad)
        else:
            bars.lacking("the disk did not become full, or the error text did not name --resume as remedy", ASKED["full"])
    finally:
        subprocess.run(["umount", str(folder)])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bin", default="target/release")
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--out", default="out/farm-bars")
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("parts", nargs="*", default=list(ASKED), metavar="PART")
    options = parser.parse_args()
    unknown = [part for part in options.parts if part not in ASKED]
    if unknown:
        parser.error(f"there is no part {', '.join(unknown)}; there are {', '.join(ASKED)}")
    parts = {"hq-frames": hq_frames, "hq-sleeping": hq_sleeping, "slurm": slurm,
             "kills": lambda farm, bars: kills(farm, bars, options.runs), "full": full}
    with Bars({name: limit for part in options.parts for name, limit in ASKED[part].items()}) as bars:
        farm = Farm(options)
        for program in (farm.entire, farm.lab):
            if not program.is_file():
                sys.exit(f"{program} is not there (cargo build --release --package entire-cli --package entire-lab --bins)")
        has_hq = subprocess.run([options.python, "-c", "import hyperqueue"], capture_output=True).returncode == 0
        for part in options.parts:
            with bars.part(*ASKED[part]):
                # Every second run with killed processes uses HyperQueue.
                if part in ("hq-frames", "hq-sleeping", "kills") and not has_hq:
                    bars.lacking(f"{options.python} has no hyperqueue (pip install hyperqueue)", ASKED[part])
                else:
                    parts[part](farm, bars)


if __name__ == "__main__":
    main()
