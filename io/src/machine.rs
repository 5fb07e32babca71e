//! Provenance of numbers: the machine, its load, the program's version and the date.

use entire_core::kernels::Level;
use serde::Serialize;

/// Returns the program's version and, if it was built from a checkout of this project's repository, the
/// commit.
pub fn version() -> String {
    match option_env!("ENTIRE_COMMIT") {
        Some(commit) => format!("{} ({commit})", env!("CARGO_PKG_VERSION")),
        None => env!("CARGO_PKG_VERSION").to_owned(),
    }
}

/// Returns the current date and time, UTC, ISO 8601 to the second.
pub fn now() -> String {
    let now = time::OffsetDateTime::now_utc();
    let (date, (hour, minute, second)) = (now.date(), now.time().as_hms());
    format!("{date}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Returns the load averages over 1, 5 and 15 minutes; `None` where the system does not report them.
pub fn load_average() -> Option<[f64; 3]> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    let mut numbers = text.split_whitespace().map(|w| w.parse::<f64>().ok());
    Some([numbers.next()??, numbers.next()??, numbers.next()??])
}

/// Returns the number of logical processors that this process may use.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, |n| n.get())
}

/// Machine, device, program and date of a report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Provenance {
    /// Processor, logical processors, operating system.
    pub machine: String,
    /// The renderer's device, with its driver.
    pub device: String,
    /// The program's version and commit.
    pub commit: String,
    /// Date and time, UTC.
    pub date: String,
    /// Load averages over 1, 5 and 15 minutes at the time of the report.
    pub load_average: Option<[f64; 3]>,
}

impl Provenance {
    /// Returns the provenance of measurements that end now.
    pub fn of(device: String) -> Self {
        Self { machine: machine(), device, commit: version(), date: now(), load_average: load_average() }
    }

    /// Returns pairs of name and value for a page.
    pub fn facts(&self) -> Vec<(&'static str, String)> {
        let load = self.load_average.map_or("not known".to_owned(), |l| {
            format!("{:.2}, {:.2}, {:.2} (1, 5, 15 minutes)", l[0], l[1], l[2])
        });
        vec![
            ("Machine", self.machine.clone()),
            ("Rendered by", self.device.clone()),
            ("Program", format!("entire {}", self.commit)),
            ("Date", self.date.clone()),
            ("Load average", load),
        ]
    }
}

/// Describes the machine: processor model, its widest vector instructions (the speed of software renderers
/// depends on them, and processors of one model name may differ in them), logical processors, operating
/// system and architecture. The host name is left out, since tables are published.
pub fn machine() -> String {
    let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let processor = cpuinfo
        .lines()
        .find_map(|l| l.strip_prefix("model name").and_then(|r| r.split_once(':')))
        .map_or("processor not known", |(_, name)| name.trim());
    let release = std::fs::read_to_string("/etc/os-release").unwrap_or_default();
    let system = release
        .lines()
        .find_map(|l| l.strip_prefix("PRETTY_NAME="))
        .map_or(std::env::consts::OS, |n| n.trim_matches('"'))
        .to_owned();
    let cores = cores();
    format!(
        "{processor}{}, {cores} logical processor{}, {system}, {}",
        vectors().map_or(String::new(), |v| format!(" ({v})")),
        if cores == 1 { "" } else { "s" },
        std::env::consts::ARCH
    )
}

/// Returns the widest vector instructions of the processor; `None` without AVX2.
fn vectors() -> Option<&'static str> {
    match Level::available().last()?.isa() {
        "avx2" => Some("AVX2"),
        "avx512" => Some("AVX-512"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_are_there() {
        let p = Provenance::of("a device".into());
        assert!(p.machine.contains("logical processor") && p.commit.starts_with(env!("CARGO_PKG_VERSION")));
        assert_eq!(p.date.len(), 20);
        assert_eq!(p.machine.contains(" (AVX"), vectors().is_some());
        assert!(p.facts().iter().any(|(_, v)| v == "a device"));
    }
}
