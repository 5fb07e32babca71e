"""Runs bundles on HyperQueue: commands come in on standard input, events go out on standard output, a JSON
object per line. Started by `entire farm --engine hyperqueue`; ends when its input is closed.

HyperQueue's Python package cannot change priorities after submission and reports no times. So only few bundles
wait in its queue, and workers measure their own seconds."""

import datetime
import json
import os
import sys
import threading
import time

# Standard output is for events only. What libraries print to it goes to standard error instead.
events = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)


def say(**event):
    events.write(json.dumps(event) + "\n")
    events.flush()


try:
    import hyperqueue
    from hyperqueue import Job
    from hyperqueue.ffi.protocol import ResourceRequest
except ImportError as error:
    say(missing=str(error))
    os._exit(1)


class Seen(Exception):
    """Raised by a callback to end a blocking wait: its first call already received the states."""


def states(client, ids):
    found = {}

    def look(jobs):
        found.update(jobs)
        raise Seen

    try:
        client.connection.wait_for_jobs(ids, look)
    except Seen:
        pass
    return found


def main():
    options = json.loads(sys.argv[1])
    cluster = None
    if options["server_dir"]:
        client = hyperqueue.Client(options["server_dir"])
    else:
        from hyperqueue import LocalCluster
        from hyperqueue.cluster import WorkerConfig

        cluster = LocalCluster()
        for _ in range(options["workers"]):
            cluster.start_worker(WorkerConfig(cores=options["cpus"]))
        client = cluster.client()
    say(ready=options["workers"])
    lock = threading.Lock()
    jobs = {}  # job id -> bundle

    def watch():
        while True:
            time.sleep(0.25)
            with lock:
                ids = list(jobs)
                if not ids:
                    continue
                found = states(client, ids)
                for job, state in found.items():
                    if not state["completed"]:
                        continue
                    bundle = jobs.pop(job)
                    if state["finished"]:
                        say(over=bundle)
                    else:
                        why = "the bundle was canceled"
                        for task in client.connection.get_failed_tasks([job]).get(job, {}).values():
                            why = task.error
                        say(failed=bundle, why=why)
                    client.forget(job)

    def guarded():
        try:
            watch()
        except BaseException as error:
            say(down=str(error))
            os._exit(1)

    threading.Thread(target=guarded, daemon=True).start()
    for line in sys.stdin:
        command = json.loads(line)
        for bundle in command["submit"]:
            seconds = bundle["min_time"]
            time_request = None if seconds is None else datetime.timedelta(seconds=seconds)
            job = Job(name=f"entire-{bundle['bundle']}", max_fails=None)
            job.program(
                bundle["args"],
                stdout=None,
                stderr=bundle["log"],
                priority=bundle["priority"],
                resources=ResourceRequest(cpus=options["cpus"], min_time=time_request),
                crash_limit=5,
            )
            with lock:
                jobs[client.submit(job).id] = bundle["bundle"]
    if cluster is not None:
        cluster.stop()
    os._exit(0)


try:
    main()
except BaseException as error:
    say(down=f"{type(error).__name__}: {error}")
    os._exit(1)
