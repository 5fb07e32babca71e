//! Test volume (a ball) for the tests that run the commands as processes.

use std::path::Path;

/// Writes a ball of 24³ bytes that is denser inside, as NRRD.
pub(crate) fn write(path: &Path) {
    let n = 24i32;
    let mut bytes =
        format!("NRRD0004\ntype: uint8\ndimension: 3\nsizes: {n} {n} {n}\nencoding: raw\n\n").into_bytes();
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                let r2 = [x, y, z].map(|v| (2 * v - n + 1).pow(2)).iter().sum::<i32>();
                bytes.push((255 - (r2 * 255 / (n * n)).min(255)) as u8);
            }
        }
    }
    std::fs::write(path, bytes).unwrap();
}
