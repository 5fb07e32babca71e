# SPDX-License-Identifier: MIT OR Apache-2.0
# `spack repo add ffi/package/spack && spack dev-build --source-path . entire@main` builds libentire from this source tree.
from spack.package import *


class Entire(Package):
    """Predicts how long a volume-rendered frame will take, and holds renderers to a frame time."""

    homepage = "https://example.org/entire"
    license("MIT OR Apache-2.0")

    version("main")

    depends_on("c", type="build")
    depends_on("rust@1.85:", type="build")
    conflicts("platform=windows")
    conflicts("platform=darwin")

    def install(self, spec, prefix):
        Executable("ffi/package/install.sh")("--prefix", str(prefix))
