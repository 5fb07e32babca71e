# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steers a ParaView render view from Python, once the plugin is loaded.

    LoadPlugin(".../EntireSteering.so", remote=False)      # and remote=True with a server
    steering = FrameTime(GetActiveView(), target=0.1)
    ...
    print(steering.read())
"""
from paraview import servermanager

READ_OUTS = (
    "PredictedTime",
    "MeasuredTime",
    "FrameTime",
    "SampleDistance",
    "ImageSampleDistance",
    "ObserverTime",
    "NumberOfSteeredFrames",
    "NumberOfFallbackFrames",
    "Reason",
    "Status",
)


class FrameTime:
    """Holds the interactive frames of `view` to `target` seconds. The properties of `self.proxy` are the settings."""

    def __init__(self, view, target=0.1, model=""):
        manager = servermanager.ProxyManager()
        proxy = manager.SMProxyManager.NewProxy("entire", "EntireSteering")
        if not proxy:
            raise RuntimeError(
                "the plugin EntireSteering is not loaded: call LoadPlugin('.../EntireSteering.so', remote=False); "
                "with a server, call it once more with remote=True"
            )
        self.proxy = servermanager._getPyProxy(proxy)
        self.proxy.SMProxy.GetProperty("View").SetProxy(0, view.SMProxy)
        self.proxy.TargetFrameTime = target
        self.proxy.ModelFileName = model
        self.proxy.UpdateVTKObjects()
        # The proxy above is read in the client; this one is read on the server, if a server draws.
        self._remote = servermanager._getPyProxy(manager.SMProxyManager.NewProxy("entire", "EntireSteeringReadOut"))
        self._remote.SMProxy.GetProperty("Source").SetProxy(0, proxy)
        self._remote.UpdateVTKObjects()
        self._frames = {}
        self._drawn_by = self.proxy

    def read(self):
        """Returns READ_OUTS as a dictionary, from the process that drew the last frame (of several ranks, rank 0)."""
        found = {}
        for proxy in (self.proxy, self._remote):
            proxy.SMProxy.UpdatePropertyInformation()
            found[proxy] = {name: proxy.SMProxy.GetProperty(name).GetElement(0) for name in READ_OUTS}
            frames = [found[proxy][name] for name in ("NumberOfSteeredFrames", "NumberOfFallbackFrames")]
            if frames != self._frames.get(proxy, [0, 0]):
                self._drawn_by = proxy
            self._frames[proxy] = frames
        return found[self._drawn_by]

    def save(self, path):
        """Writes the learned state to a file, in the process that renders."""
        self.proxy.SMProxy.GetProperty("Save").SetElement(0, path)
        self.proxy.SMProxy.UpdateProperty("Save", 1)

    def release(self):
        """Releases the view."""
        self._remote.SMProxy.GetProperty("Source").SetNumberOfProxies(0)
        self._remote.UpdateVTKObjects()
        self.proxy.SMProxy.GetProperty("View").SetNumberOfProxies(0)
        self.proxy.UpdateVTKObjects()
