//! Waits for submissions with a time limit: devices may be lost or hang.

use super::{Engine, with_pass};
use crate::error::{Error, Result};
use crate::vulkan::gpu::NamedCall;
use ash::vk;
use std::sync::atomic::Ordering;

impl Engine {
    /// Waits until no submission is running.
    pub(crate) fn drain(&mut self) -> Result<()> {
        if self.pending { self.wait("an earlier pass") } else { self.gpu.check() }
    }

    /// Waits for the end of the submission.
    pub(super) fn wait(&mut self, pass: &str) -> Result<()> {
        self.gpu.check()?;
        self.wait_for_fence(pass)?;
        // SAFETY: the fence has signaled, so no pending submission uses it.
        unsafe { self.gpu.device.reset_fences(&[self.fence.get()]) }.on(&self.gpu, "vkResetFences")?;
        self.pending = false;
        Ok(())
    }

    /// Waits for the fence up to the time limit of a submission, and leaves the fence signaled. After a
    /// submission has exceeded the limit, only polls the fence.
    fn wait_for_fence(&mut self, pass: &str) -> Result<()> {
        let longest = self.gpu.longest_wait;
        let nanoseconds = if self.hangs { 0 } else { u64::try_from(longest.as_nanos()).unwrap_or(u64::MAX) };
        let fences = [self.fence.get()];
        // SAFETY: the fence is alive, and only this thread waits for it or resets it.
        match unsafe { self.gpu.device.wait_for_fences(&fences, true, nanoseconds) } {
            Err(vk::Result::TIMEOUT) => {
                if !std::mem::replace(&mut self.hangs, true) {
                    self.gpu.hanging.fetch_add(1, Ordering::Relaxed);
                }
                Err(Error::new(format!(
                    "the device {} has not finished {pass} within {} s and counts as hanging; use smaller \
                     tiles (ENTIRE_TILE) or a coarser step, allow it more seconds (ENTIRE_DEVICE_WAIT), \
                     choose another device (ENTIRE_DEVICE), or render on the CPU",
                    self.gpu.name,
                    longest.as_secs_f64()
                )))
            }
            done => {
                done.on(&self.gpu, "vkWaitForFences").map_err(|e| with_pass(&e, pass))?;
                if std::mem::take(&mut self.hangs) {
                    self.gpu.hanging.fetch_sub(1, Ordering::Relaxed);
                }
                Ok(())
            }
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        // Nothing runs on a lost device. A submission on a hanging device may still use resources, which
        // therefore are not freed.
        if self.pending
            && !self.gpu.is_lost()
            && self.wait_for_fence("its last pass").is_err()
            && !self.gpu.is_lost()
        {
            self.gpu.abandon();
        }
    }
}
