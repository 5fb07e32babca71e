//! Target frame times as text.

use anyhow::{Result, anyhow, bail, ensure};

/// Reads `33ms`, `0.033s`, `33000us`, `30fps` or `30hz` as seconds.
///
/// # Errors
/// For any other text; the error names the accepted forms.
pub fn parse_target(text: &str) -> Result<f64> {
    let lower = text.trim().to_ascii_lowercase();
    let split = lower.find(|c: char| c.is_alphabetic() && c != 'e').unwrap_or(lower.len());
    let (number, unit) = lower.split_at(split);
    let accepted = "give a time like 33ms or 0.033s, or a rate like 30fps";
    let value: f64 =
        number.trim().parse().map_err(|_| anyhow!("target {text:?} has no number; {accepted}"))?;
    let seconds = match unit.trim() {
        "ms" => value * 1e-3,
        "s" => value,
        "us" | "µs" | "μs" => value * 1e-6,
        "fps" | "hz" => 1.0 / value,
        _ => bail!("target {text:?} has no known unit; {accepted}"),
    };
    ensure!(
        seconds.is_finite() && seconds > 0.0 && value > 0.0,
        "target {text:?} is not a finite positive time; {accepted}"
    );
    Ok(seconds)
}
