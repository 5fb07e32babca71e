//! The host's clocks.

use std::time::Instant;

/// CPU time of this process so far, all threads, in seconds. `None` if the system does not report it.
pub(crate) fn process_cpu_seconds() -> Option<f64> {
    #[cfg(unix)]
    {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Some(t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9)
    }
    #[cfg(not(unix))]
    None
}

/// Measures wall and CPU time since its start.
pub(crate) struct Stopwatch {
    wall: Instant,
    cpu: Option<f64>,
}

impl Stopwatch {
    pub(crate) fn start() -> Self {
        Self { cpu: process_cpu_seconds(), wall: Instant::now() }
    }

    /// Wall seconds since the start.
    pub(crate) fn wall(&self) -> f64 {
        self.wall.elapsed().as_secs_f64()
    }

    /// CPU seconds of this process, all threads, since the start. `None` if the system does not report them.
    pub(crate) fn cpu(&self) -> Option<f64> {
        Some((process_cpu_seconds()? - self.cpu?).max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn work_costs_cpu_time_and_sleep_does_not_cost_it_all() {
        let watch = Stopwatch::start();
        let mut x = 1u64;
        while watch.wall() < 0.02 {
            x = std::hint::black_box(x.wrapping_mul(6364136223846793005).wrapping_add(1));
        }
        assert!(watch.cpu().unwrap() > 0.0, "{x}");
    }
}
