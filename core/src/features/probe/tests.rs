//! Packets of rays against single rays, and lazy classification against the whole one.

use crate::features::tests::{noise, summary, table};
use crate::features::*;
use crate::kernels::Level;
use crate::scene::*;

#[test]
fn packets_of_rays_find_what_single_rays_find_on_every_level() {
    // Cells of one block and of several, cameras outside, inside and looking past, thin and opaque tables.
    let data = noise(64 * 48 * 40, 7);
    for (cells, dims) in [(48, [64, 48, 40]), (3, [64, 48, 40]), (48, [1, 48, 40])] {
        let s = summary(&data[..dims[0] * dims[1] * dims[2]], dims, cells);
        for cut in [255usize, 250, 128, 0] {
            let table = table(|i| if i >= cut { 0.02 + 0.5 * (i as f32 / 255.0) } else { 0.0 });
            let mut transfer = TransferSummary::new(&s, &table);
            for (rx, ry, dz) in [(0.0, 0.0, 2.0), (33.0, 71.0, 1.3), (-80.0, 10.0, 0.2), (10.0, 200.0, 9.0)] {
                let camera = Camera::from_arcball(Arcball { rx, ry, dz }).unwrap();
                let frame = Frame::new(camera, 320, 200).unwrap();
                for shading in [Shading::None, Shading::Scatter] {
                    let frame = frame.with_shading(shading);
                    for side in [1, 4, 11, 24] {
                        let single = Probe::by_single_rays(&s, &mut transfer, &frame, side);
                        for level in Level::available() {
                            let packets = Probe::on(level, &s, &mut transfer, &frame, side);
                            assert_eq!(packets, single, "{dims:?} {cut} {rx} {shading:?} {side} {level:?}");
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn cells_are_classified_alike_by_ranges_and_by_lookup() {
    let data = noise(40 * 24 * 24, 3);
    for cells in [48, 2] {
        let s = summary(&data, [40, 24, 24], cells);
        // One run of visible entries, some, and more than are compared run by run.
        for period in [256usize, 64, 16, 2] {
            let table = table(|i| if i % period == period / 2 { 0.3 } else { 0.0 });
            let t = TransferSummary::new(&s, &table);
            let [nx, ny, nz] = s.cells();
            for (x, y, z) in (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| (x, y, z))))
            {
                if s.block_edge() == s.cell_edge() {
                    let (low, high) = s.cell_bounds(x, y, z);
                    let empty = !(low..=high).any(|i| table.is_visible(usize::from(i)));
                    assert_eq!(t.is_empty(x, y, z), empty, "{period} {x} {y} {z}");
                }
            }
        }
    }
}

#[test]
fn an_edit_forgets_what_cells_were() {
    let data = noise(24 * 24 * 24, 5);
    let s = summary(&data, [24; 3], 48);
    let (thin, thick) = (table(|_| 0.001), table(|_| 0.6));
    let frame =
        Frame::new(Camera::from_arcball(Arcball { rx: 10.0, ry: 20.0, dz: 1.8 }).unwrap(), 64, 64).unwrap();
    let mut edited = TransferSummary::new(&s, &thin);
    for table in [&thick, &thin, &thick] {
        edited.update(&s, table);
        let found = Probe::new(&s, &mut edited, &frame, 11);
        assert_eq!(found, Probe::new(&s, &mut TransferSummary::new(&s, table), &frame, 11));
    }
}
