//! The log: a CSV file with a row for each frame, each loaded volume, each view that was refined to full
//! quality, and each action `full_frame` of a script.

use crate::steering::FrameRecord;
use anyhow::{Context, Result};
use std::fs::File;
use std::io::{LineWriter, Write};
use std::path::Path;

/// Values of a row that are not in the frame's record.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Beside<'a> {
    pub(crate) controller: &'a str,
    /// Number of pictures that the window has shown since the oldest input event whose effect is first
    /// visible in this frame's picture; this picture is counted too. 0 without such an event.
    pub(crate) input_frames: u64,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Seconds from the beginning of the frame to its plan.
    pub(crate) before: f64,
    /// Seconds of drawing and presenting the interface, until the device has finished.
    pub(crate) shown: f64,
    /// Processor seconds of presentation, which the interface's seconds do not include.
    pub(crate) handing: f64,
}

/// A log file that is being written.
pub(crate) struct Log {
    /// Line-buffered, so that watchers see each row at once.
    out: LineWriter<File>,
}

impl Log {
    /// Creates a log file with its header row.
    pub(crate) fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
        let mut out = LineWriter::new(file);
        writeln!(
            out,
            "frame,kind,seconds,cast_seconds,interface_cpu_seconds,before_seconds,shown_seconds,target_seconds,\
             predicted_seconds,upper_seconds,full_seconds,step,image_sample_distance,width,height,reason,switched,\
             controller,input_frames,resident_bytes,handing_cpu_seconds"
        )?;
        Ok(Self { out })
    }

    /// Writes the row of a frame.
    pub(crate) fn frame(&mut self, r: &FrameRecord, b: &Beside<'_>) -> Result<()> {
        writeln!(
            self.out,
            "{},frame,{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.4},{:.4},{},{},{},{},{},{},{},{:.6}",
            r.number,
            r.seconds,
            r.cast,
            r.interface,
            b.before,
            b.shown,
            r.target,
            r.predicted,
            r.upper,
            r.full,
            r.step,
            r.image_sample_distance,
            b.width,
            b.height,
            r.reason,
            u8::from(r.switched),
            b.controller,
            b.input_frames,
            resident_bytes(),
            b.handing
        )?;
        Ok(())
    }

    /// Writes the row of a timed activity other than a frame: its kind, total seconds, seconds of ray
    /// casting, and seconds of the longest slice. For the kind `open`, the last number is the seconds of the
    /// first frame.
    pub(crate) fn event(
        &mut self,
        frame: u64,
        kind: &str,
        [seconds, cast, longest]: [f64; 3],
        target: f64,
    ) -> Result<()> {
        writeln!(
            self.out,
            "{frame},{kind},{seconds:.6},{cast:.6},,,{longest:.6},{target:.6},,,,,,,,,,,,{},",
            resident_bytes()
        )?;
        Ok(())
    }
}

/// Resident memory of this process, bytes; 0 if the system does not report it.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kilobytes = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.split_whitespace().next());
    kilobytes.and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) * 1024
}

/// Processor time of the calling thread, seconds; 0 if the system does not report it.
pub(crate) fn thread_seconds() -> f64 {
    #[cfg(unix)]
    {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
    }
    #[cfg(not(unix))]
    {
        0.0
    }
}
