//! `entire_transfer_function`: Gaussian lobes, VTK's nodes, or a table.

use crate::abi::{slice, slice_mut};
use crate::guard::{changing, entry, freeing, making, reading};
use crate::handle::{Held, handle};
use crate::limits::{ENTIRE_MAX_TRANSFER_POINTS, at_most};
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::{Failure, refuse};
use entire_core::memory::collected;
use entire_core::scene::{GaussianLobe, Node, Nodes, TABLE_LEN, TransferFunction, TransferTable};

/// A Gaussian lobe of the opacity function O(s) = sum of height * exp(-(s - center)^2 / width).
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_gaussian_lobe {
    /// Normalized scalar value at which the lobe peaks, in [0, 1].
    pub center: f32,
    /// Width of the lobe, positive: the squared distance from the center at which it has fallen to 1/e.
    pub width: f32,
    /// Opacity at the peak, not negative.
    pub height: f32,
}

/// A node of an opacity function, as in vtkPiecewiseFunction.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_opacity_node {
    /// Scalar value, in the unit of the function's range.
    pub position: f64,
    /// Opacity in [0, 1] over one unit distance.
    pub opacity: f64,
    /// Position of the half-way value between this node and the next, in [0, 1]; 0.5 is the middle.
    pub midpoint: f64,
    /// Sharpness of the change, in [0, 1]: 0 linear, 1 nearly a step.
    pub sharpness: f64,
}

/// A node of a color function, as in vtkColorTransferFunction with RGB as its color space.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_color_node {
    /// Scalar value, in the unit of the function's range.
    pub position: f64,
    /// Red, green, blue in [0, 1].
    pub color: [f64; 3],
    /// Position of the half-way value between this node and the next, in [0, 1]; 0.5 is the middle.
    pub midpoint: f64,
    /// Sharpness of the change, in [0, 1]: 0 linear; values over 0.99 make a step.
    pub sharpness: f64,
}

/// Unit of length of a unit distance: one of the `ENTIRE_UNIT_*` numbers.
pub type entire_unit = u32;
/// Multiples of the reference step, which is the volume's smallest voxel spacing.
pub const ENTIRE_UNIT_REFERENCE_STEP: entire_unit = 1;
/// The unit of the volume's spacing (VTK's ScalarOpacityUnitDistance, ANARI's unitDistance).
pub const ENTIRE_UNIT_WORLD: entire_unit = 2;

/// Number of entries of the table of every transfer function.
pub const ENTIRE_TABLE_ENTRIES: usize = 256;
const _: () = assert!(ENTIRE_TABLE_ENTRIES == TABLE_LEN);

/// Colors and opacities over normalized scalar values. Immutable except for its unit distance. Sessions copy
/// the data that they need.
pub struct entire_transfer_function(Held<Transfer>);

#[derive(Clone, Copy)]
pub(crate) enum UnitDistance {
    ReferenceSteps(f32),
    World(f32),
}

pub(crate) struct Transfer {
    pub(crate) function: TransferFunction,
    pub(crate) table: TransferTable,
    pub(crate) unit: UnitDistance,
}

handle!(entire_transfer_function, Transfer);

fn at_most_points(what: &str, found: usize) -> Result<(), Failure> {
    at_most(what, found, ENTIRE_MAX_TRANSFER_POINTS, "ENTIRE_MAX_TRANSFER_POINTS")
}

/// Name of the output of the functions that make a transfer function, in messages.
const OUTPUT: &str = "transfer_function (output)";

fn transfer(function: TransferFunction) -> Result<Transfer, Failure> {
    let table = function.to_table()?;
    Ok(Transfer { function, table, unit: UnitDistance::ReferenceSteps(1.0) })
}

/// Makes a transfer function of Gaussian opacity lobes; with no lobes it is transparent everywhere. Colors
/// come from a built-in ramp, since they do not change the time of a frame. The unit distance is one
/// reference step.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a lobe that is not finite, a width that is not positive, a negative
/// height), ENTIRE_SIZE_MISMATCH (over ENTIRE_MAX_TRANSFER_POINTS), ENTIRE_OUT_OF_MEMORY,
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_from_lobes(
    lobes: *const entire_gaussian_lobe,
    lobe_count: usize,
    transfer_function: *mut *mut entire_transfer_function,
) -> entire_result {
    entry!(making(transfer_function, OUTPUT, || {
        at_most_points("lobe_count", lobe_count)?;
        let lobes = slice(lobes, lobe_count, "lobes")?;
        let lobes = lobes.iter().map(|l| GaussianLobe { center: l.center, width: l.width, height: l.height });
        transfer(TransferFunction::Gaussian(collected(lobes)?))
    }))
}

/// Makes a transfer function of opacity and color nodes as in VTK and ParaView. Its values equal those of
/// vtkPiecewiseFunction and vtkColorTransferFunction (RGB) within 1e-6. `low` and `high` are the scalar
/// values that map to 0 and 1: pass the volume's range, that of entire_volume_desc, or, if that was NaN, of
/// entire_volume_describe (advanced.h). Nodes must be in ascending order of position; two nodes at the same
/// position make a step. Without opacity nodes everything is transparent; without color nodes the built-in
/// ramp is used. If `clamping` is not 0, the values of the outermost nodes continue beyond them, which is
/// VTK's default; if it is 0, everything beyond them is transparent and black. The unit distance is one
/// reference step until entire_transfer_function_set_unit_distance changes it.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (an invalid node, which the error text names, or a range that is not
/// finite or has `low` over `high`), ENTIRE_SIZE_MISMATCH (over ENTIRE_MAX_TRANSFER_POINTS opacity or color
/// nodes), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_from_nodes(
    opacity: *const entire_opacity_node,
    opacity_count: usize,
    color: *const entire_color_node,
    color_count: usize,
    low: f64,
    high: f64,
    clamping: u32,
    transfer_function: *mut *mut entire_transfer_function,
) -> entire_result {
    entry!(making(transfer_function, OUTPUT, || {
        at_most_points("opacity_count", opacity_count)?;
        at_most_points("color_count", color_count)?;
        let opacity = slice(opacity, opacity_count, "opacity")?.iter().map(|n| Node {
            position: n.position,
            value: n.opacity,
            midpoint: n.midpoint,
            sharpness: n.sharpness,
        });
        let color = slice(color, color_count, "color")?.iter().map(|n| Node {
            position: n.position,
            value: n.color,
            midpoint: n.midpoint,
            sharpness: n.sharpness,
        });
        let (opacity, color) = (collected(opacity)?, collected(color)?);
        transfer(TransferFunction::Nodes(Nodes { opacity, color, range: (low, high), clamp: clamping != 0 }))
    }))
}

/// Makes a transfer function from a table: `entries` entries of red, green, blue and opacity in [0, 1], not
/// premultiplied. The first entry is at the normalized scalar value 0, the last at 1; values in between are
/// interpolated linearly. The unit distance is one reference step.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (fewer than 2 entries, a value outside [0, 1]), ENTIRE_SIZE_MISMATCH
/// (over ENTIRE_MAX_TRANSFER_POINTS), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_from_table(
    rgba: *const f32,
    entries: usize,
    transfer_function: *mut *mut entire_transfer_function,
) -> entire_result {
    entry!(making(transfer_function, OUTPUT, || {
        at_most_points("entries", entries)?;
        // Four floats have the alignment of one.
        let rgba = slice(rgba.cast::<[f32; 4]>(), entries, "rgba")?;
        transfer(TransferFunction::uniform(rgba)?)
    }))
}

/// Sets the distance along the ray over which the opacities hold, positive, in the given unit.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a distance that is out of range, an unknown unit),
/// ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_set_unit_distance(
    transfer_function: *mut entire_transfer_function,
    distance: f32,
    unit: entire_unit,
) -> entire_result {
    entry!(changing(transfer_function, |transfer| {
        reserve::check()?;
        // This only checks the distance; entire_session_set_transfer_function applies it.
        transfer.table.clone().with_unit_distance(distance)?;
        transfer.unit = match unit {
            ENTIRE_UNIT_REFERENCE_STEP => UnitDistance::ReferenceSteps(distance),
            ENTIRE_UNIT_WORLD => UnitDistance::World(distance),
            other => refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "unit is {other}; it must be ENTIRE_UNIT_REFERENCE_STEP (1) \
                 or ENTIRE_UNIT_WORLD (2)"
            ),
        };
        Ok(())
    }))
}

/// Copies the table that predictions use: ENTIRE_TABLE_ENTRIES times red, green, blue, opacity over one unit
/// distance. `capacity` counts floats.
///
/// Fails with ENTIRE_SIZE_MISMATCH (fewer than 4 * ENTIRE_TABLE_ENTRIES floats), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_table(
    transfer_function: *const entire_transfer_function,
    rgba: *mut f32,
    capacity: usize,
) -> entire_result {
    entry!(reading(transfer_function, |transfer| {
        let table = transfer.table.rgba().as_flattened();
        if capacity < table.len() {
            refuse!(ENTIRE_SIZE_MISMATCH, "rgba holds {capacity} floats; the table has {}", table.len());
        }
        slice_mut(rgba, table.len(), "rgba")?.copy_from_slice(table);
        Ok(())
    }))
}

/// Frees a transfer function; NULL does nothing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_transfer_function_free(transfer_function: *mut entire_transfer_function) {
    entry!(freeing(transfer_function))
}
