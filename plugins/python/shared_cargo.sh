#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The cargo that run.sh gives to maturin in the gate. It builds what the gate has built, the whole workspace, and prints
# cargo's messages, in which maturin finds the native module. For this package alone, cargo would choose other features of
# the crates below it and compile them again.
set -euo pipefail
cd "$(dirname "$0")/../.."
# With maturin's settings of PyO3, PyO3 would be compiled again.
unset "${!PYO3_@}"
exec "${ENTIRE_CARGO:-cargo}" build --workspace --features entire-cli/explore --all-targets --locked \
    --message-format json-render-diagnostics
