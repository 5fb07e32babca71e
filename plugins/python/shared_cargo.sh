#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The cargo that run.sh gives to maturin in the gate. It builds what the gate has built, the whole workspace, and prints
# cargo's messages, in which maturin finds the native module. If cargo built this package alone, it would choose other
# features of the package's dependencies and compile the dependencies again.
set -euo pipefail
cd "$(dirname "$0")/../.."
# Removes maturin's settings of PyO3, with which cargo would compile PyO3 again.
unset "${!PYO3_@}"
exec "${ENTIRE_CARGO:-cargo}" build --workspace --features entire-cli/explore --all-targets --locked \
    --message-format json-render-diagnostics
