//! Natural order of file names: numbers in them are compared by value.

use std::cmp::Ordering;
use std::collections::HashSet;
use std::path::PathBuf;

/// Sorts paths by text, and by value where they contain numbers.
///
/// A number is a sequence of digits of any length, with the following additions:
/// - A fraction, if exactly one point is between digits: `0.25`; `1.2.3` is three numbers.
/// - An exponent, if no letter or digit follows it: `1e-3`, `2.5E+4`. After an integer, an exponent without a
///   sign is recognized only if neither is padded with zeros: `s01e02` is two numbers.
/// - The sign `+` before it, except directly after another number.
/// - The sign `-` before it: at the start of the path; after any character except a letter, a digit or `-`
///   (`t_-1`); and after a letter if another name has a number without a sign there (`t-1` and `t0`).
///   Otherwise `-` is a hyphen (`run-1`, `2024-01-05`).
///
/// Equal numbers (`1`, `01`, `1.0`) are ordered by the rest of the name, then by text.
pub(crate) fn sort(paths: &mut Vec<PathBuf>) {
    let texts: Vec<String> = paths.iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let mut keys: Vec<Vec<Token>> = texts.iter().map(|t| tokens(t)).collect();
    let plain: HashSet<(usize, String)> = keys
        .iter()
        .flat_map(|k| k.iter().enumerate())
        .filter(|(_, t)| t.number.is_some())
        .map(|(i, t)| (i, t.text.strip_suffix('+').unwrap_or(&t.text).to_owned()))
        .collect();
    for key in &mut keys {
        let mut after_number = false;
        for (i, token) in key.iter_mut().enumerate() {
            token.take_sign(after_number, |bare| plain.contains(&(i, bare.to_owned())));
            after_number = token.number.is_some();
        }
    }
    let mut order: Vec<_> = keys.into_iter().zip(texts).zip(std::mem::take(paths)).collect();
    order.sort_by(|a, b| a.0.cmp(&b.0));
    paths.extend(order.into_iter().map(|(_, path)| path));
}

/// A text and the number after it; the last token of a name has no number.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Token {
    text: String,
    number: Option<Number>,
}

impl Token {
    /// Moves `+` or `-` from the end of the text to the number, if it is the number's sign. `after_number`:
    /// true if the previous token has a number; `is_there`: true if another name has a number after the text.
    fn take_sign(&mut self, after_number: bool, is_there: impl Fn(&str) -> bool) {
        let Some(number) = &mut self.number else { return };
        let mut rest = self.text.chars();
        let sign = rest.next_back();
        let before = rest.clone().next_back();
        let bare = rest.as_str();
        let is_sign = match (sign, before) {
            (Some('+' | '-'), None) => !after_number,
            (Some('+'), Some(_)) => true,
            (Some('-'), Some('-')) => false,
            (Some('-'), Some(c)) => !c.is_alphanumeric() || is_there(bare),
            _ => false,
        };
        if is_sign {
            number.negative = sign == Some('-');
            self.text = bare.to_owned();
        }
    }
}

/// A number as 0.DIGITS · 10^point, without rounding.
#[derive(Debug, PartialEq, Eq)]
struct Number {
    negative: bool,
    point: i64,
    digits: String,
}

impl Number {
    fn new(whole: &str, fraction: &str, exponent: i64) -> Self {
        let all = format!("{whole}{fraction}");
        let digits = all.trim_start_matches('0');
        let point = whole.len() as i64 - (all.len() - digits.len()) as i64;
        let digits = digits.trim_end_matches('0').to_owned();
        let point = if digits.is_empty() { 0 } else { point.saturating_add(exponent) };
        Self { negative: false, point, digits }
    }
}

impl Ord for Number {
    fn cmp(&self, other: &Self) -> Ordering {
        let side = |n: &Self| match (n.digits.is_empty(), n.negative) {
            (true, _) => 0,
            (false, true) => -1,
            (false, false) => 1,
        };
        let size = (self.point, &self.digits).cmp(&(other.point, &other.digits));
        side(self).cmp(&side(other)).then(if side(self) < 0 { size.reverse() } else { size })
    }
}

impl PartialOrd for Number {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The digits at the start of a text.
fn digits(text: &str) -> &str {
    &text[..text.bytes().position(|b| !b.is_ascii_digit()).unwrap_or(text.len())]
}

/// The digits after a point at the start of a text; empty if there are none.
fn fraction(text: &str) -> &str {
    text.strip_prefix('.').map_or("", digits)
}

/// Returns length and value of an exponent at the start of a text. `fraction`: true if the number before it
/// has a fraction; `padded`: true if this number is padded with zeros. Without a fraction, an exponent
/// without a sign counts only if neither the number nor the exponent is padded.
fn exponent(text: &str, fraction: bool, padded: bool) -> Option<(usize, i64)> {
    let rest = text.strip_prefix(['e', 'E'])?;
    let unsigned = rest.strip_prefix(['+', '-']);
    let found = digits(unsigned.unwrap_or(rest));
    let length = 1 + usize::from(unsigned.is_some()) + found.len();
    let ends = text[length..].chars().next().is_none_or(|c| !c.is_alphanumeric());
    let counts = unsigned.is_some() || fraction || !(padded || found.starts_with('0'));
    if found.is_empty() || !ends || !counts {
        return None;
    }
    let size = found.bytes().fold(0i64, |n, b| n.saturating_mul(10).saturating_add(i64::from(b - b'0')));
    let size = size.min(1 << 60);
    Some((length, if rest.starts_with('-') { -size } else { size }))
}

fn tokens(text: &str) -> Vec<Token> {
    let mut out = Vec::new();
    let (mut rest, mut before) = (text, String::new());
    // In a version such as 1.2.3: number of parts that are still to be read.
    let mut parts = 0usize;
    while let Some(c) = rest.chars().next() {
        if !c.is_ascii_digit() {
            before.push(c);
            rest = &rest[c.len_utf8()..];
            continue;
        }
        let whole = digits(rest);
        let behind = &rest[whole.len()..];
        if parts == 0 {
            let mut end = behind;
            while !fraction(end).is_empty() {
                end = &end[1 + fraction(end).len()..];
                parts += 1;
            }
            // Two or more points make a version; one point makes a fraction.
            parts = if parts > 1 { parts + 1 } else { 0 };
        }
        let (mut part, mut length, mut power) = ("", whole.len(), 0);
        if parts > 0 {
            parts -= 1;
        } else {
            part = fraction(behind);
            length += if part.is_empty() { 0 } else { 1 + part.len() };
            let padded = whole.len() > 1 && whole.starts_with('0');
            if let Some((more, value)) = exponent(&rest[length..], !part.is_empty(), padded) {
                length += more;
                power = value;
            }
        }
        let number = Some(Number::new(whole, part, power));
        out.push(Token { text: std::mem::take(&mut before), number });
        rest = &rest[length..];
    }
    out.push(Token { text: before, number: None });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks that the names, if they are given in reversed order, are sorted into this order.
    fn stays(names: &[&str]) {
        let want: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
        let mut paths: Vec<PathBuf> = want.iter().rev().cloned().collect();
        sort(&mut paths);
        assert_eq!(paths, want);
    }

    #[test]
    fn numbers_sort_by_value() {
        stays(&["a/step1.nrrd", "a/step2.nrrd", "a/step10.nrrd", "a/step100.nrrd"]);
        stays(&["t0.25.vti", "t0.5.vti", "t1.vti", "t1.05.vti", "t1.5.vti", "t10.vti"]);
        // These numbers exceed every integer type.
        stays(&[
            "t9",
            "t99999999999999999999999999999999999999999999",
            "t100000000000000000000000000000000000000000000",
        ]);
        stays(&["t1e-3.vti", "t2.5e-2.vti", "t1.vti", "t1e1.vti", "t15.vti", "t2E+1.vti"]);
        stays(&["s01e02.mha", "s01e10.mha", "s02e01.mha"]);
        stays(&["v1.2.9", "v1.2.10", "v1.10.1"]);
        stays(&["m1_t2.mha", "m1_t10.mha", "m2_t1.mha", "m10_t1.mha"]);
        // Equal numbers are ordered by the rest of the name, then by text.
        stays(&["t01.a", "t1.a", "t01.b", "t1.b"]);
        stays(&["1e3f", "1e20f"]);
    }

    #[test]
    fn a_minus_is_a_sign_where_it_can_be_told() {
        stays(&["t-10.vti", "t-2.vti", "t0.vti", "t3.vti"]);
        stays(&["t-0.5.vti", "t+0.25.vti", "t+1.vti"]);
        stays(&["t_-2.vti", "t_-1.vti", "t_1.vti"]);
        stays(&["-2", "-1", "0", "1"]);
        // Here the character `-` is a hyphen.
        stays(&["run-1.vti", "run-2.vti", "run-10.vti"]);
        stays(&["2023-12-31", "2024-01-05", "2024-02-01"]);
    }
}
