# SPDX-License-Identifier: MIT OR Apache-2.0
"""Loads the plugin and checks that it steers: pvbatch, pvpython, several ranks, or a client of a pvserver.

    xvfb-run -a pvbatch check.py PLUGIN.so FOLDER [--server HOST:PORT] [--name NAME]
"""
import argparse
import os
import sys
import time

# Folder of ParaView's modules, if they are unpacked and not installed. It comes first, before the modules of another
# VTK.
if os.environ.get("PARAVIEW_MODULES"):
    sys.path.insert(0, os.environ["PARAVIEW_MODULES"])

from paraview.simple import *  # noqa: F401,F403

sys.path.insert(0, os.environ.get("ENTIRE_SCRIPTS") or os.path.dirname(os.path.abspath(__file__)))
from entire_paraview import FrameTime  # noqa: E402

parser = argparse.ArgumentParser()
parser.add_argument("plugin")
parser.add_argument("folder")
parser.add_argument("--server")
parser.add_argument("--name", default="check")
# The graphical client runs scripts without arguments; the variable has one argument in each line.
given = os.environ.get("ENTIRE_CHECK")
options = parser.parse_args(given.splitlines() if given else None)


def say(text):
    # The graphical client does not print the output of scripts.
    with open(os.path.join(options.folder, f"{options.name}.txt"), "a") as file:
        file.write(text + "\n")
    print(text, flush=True)


def check(condition, text):
    say(f"{'ok' if condition else 'FAILED'}: {options.name}: {text}")
    if not condition:
        os._exit(1)


if options.server:
    host, port = options.server.split(":")
    Connect(host, int(port))
    LoadPlugin(options.plugin, remote=True)
if not given:
    LoadPlugin(options.plugin, remote=False)

paraview.simple._DisableFirstRenderCameraReset()
source = Wavelet(WholeExtent=[-40, 40, -40, 40, -40, 40])
view = GetActiveViewOrCreate("RenderView") if given else CreateView("RenderView")
view.ViewSize = [320, 240]
view.OrientationAxesVisibility = 0
view.RemoteRenderThreshold = 0
display = Show(source, view)
display.SetRepresentationType("Volume")
ColorBy(display, ("POINTS", "RTData"))
display.SetScalarBarVisibility(view, False)
ResetCamera(view)


def shot(name):
    path = os.path.join(options.folder, f"{options.name}-{name}.png")
    if os.path.exists(path):
        os.remove(path)
    SaveScreenshot(path, view, ImageResolution=[320, 240])
    with open(path, "rb") as file:
        return file.read()


def interact(azimuth=5):
    view.GetActiveCamera().Azimuth(azimuth)
    view.SMProxy.InteractiveRender()


if given:
    # Several frames, since the client's window is still being opened.
    for _ in range(3):
        shot("plain")
plain = shot("plain")
steering = FrameTime(view, target=1e-4)
attached = shot("attached")
check(attached == plain, "a screenshot with the plugin attached equals the screenshot without it, byte for byte")
for _ in range(6):
    interact()
read = steering.read()
say(str(read))
check(read["NumberOfSteeredFrames"] > 0, f"{read['NumberOfSteeredFrames']} interactive frames were steered")
check(read["NumberOfFallbackFrames"] == 0, "no frame lacked a prediction")
check(read["Reason"] == "target unreachable", "an unreachable target gives the coarsest allowed settings")
check(read["ImageSampleDistance"] > 2 and read["MeasuredTime"] > 0, "the read-outs have steps and times")
coarse = read["SampleDistance"]
view.GetActiveCamera().Azimuth(-30)
again = shot("after")
check(again == plain, "a screenshot after steered frames is still the same, byte for byte")
steering.proxy.TargetFrameTime = 1000.0
for _ in range(3):
    interact()
read = steering.read()
check(read["SampleDistance"] < 0.5 * coarse, "with a long target, the sample distance is under half of the coarsest")
before = read["NumberOfSteeredFrames"]
steering.proxy.Enabled = 0
interact()
read = steering.read()
check(read["NumberOfSteeredFrames"] == before and read["Reason"] == "off", "ParaView draws alone with steering off")
steering.proxy.Enabled = 1
state = os.path.join(options.folder, f"{options.name}.state")
if os.path.exists(state):
    os.remove(state)
steering.save(state)
# A server writes the file while the client continues. The server runs on this machine and in the same folder.
until = time.monotonic() + 10
while not os.path.exists(state) and time.monotonic() < until:
    time.sleep(0.1)
check(os.path.exists(state) and os.path.getsize(state) > 16, "the learned state is saved")
steering.proxy.ModelFileName = "/nowhere/model.safetensors"
interact()
read = steering.read()
check(read["Reason"] == "fallback" and "/nowhere/model" in read["Status"], "Status names a missing model")
steering.proxy.ModelFileName = ""
interact()
check(steering.read()["Reason"] != "fallback", "steering continues when the model's name is removed")
# Gives a folder in place of a saved state. The error goes to the console, since no message window is open.
steering.proxy.StateFileName = options.folder
steering.proxy.UpdateVTKObjects()
before = steering.read()["NumberOfSteeredFrames"]
interact()
check(steering.read()["NumberOfSteeredFrames"] > before, "a folder is refused as a saved state, and steering continues")
steering.proxy.StateFileName = ""
steering.proxy.UpdateVTKObjects()
# Changes the data, then hides the volume and shows it again.
source.WholeExtent = [-30, 30, -30, 30, -30, 30]
interact()
interact()
check(steering.read()["Reason"] not in ("fallback", ""), "frames of other data are steered")
Hide(source, view)
interact()
Show(source, view)
interact()
steering.release()
view.GetActiveCamera().Azimuth(1)
view.SMProxy.InteractiveRender()
if not given:
    # Not in the graphical client: ParaView 5.11 hangs if a start-up script deletes its last view.
    Delete(view)
Delete(source)
say(f"passed: {options.name}")
