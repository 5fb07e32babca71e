//! The controllers that commands can name.

use super::play::{ActsOn, Contender};
use super::rivals::{
    Algorithm1, Filament, Fixed, Olp, Pid, Reactive, Recent, Rule, StepResponse, Unreal, VtkFixedPoint,
    VtkGpu, VtkJs,
};
use clap::ValueEnum;
use entire_steer::control::{Controller, HybridOptions, Session};
use entire_steer::predict::Predictor;

/// Names of the controllers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, ValueEnum)]
pub enum ControllerKind {
    /// Always the same step.
    Fixed,
    /// Mean of the last three frame times, converted to the reference step by the measured curve of frame time
    /// over step.
    Olp,
    /// The last frame time, converted to the reference step by this curve.
    Last,
    /// The longer of the last two frame times, converted to the reference step by this curve.
    LargerOfTwo,
    /// PID: proportional, integral and derivative feedback on the step.
    Pid,
    /// The paper's Algorithm 1: prediction at the reference step, converted to other steps by this curve.
    Algorithm1,
    /// entire's controller: a prediction for every step, corrected by observed frames, with a safety margin.
    Hybrid,
    /// VTK's rule for GPU ray casting, on the ray step.
    VtkGpu,
    /// VTK's rule for fixed-point ray casting, on image resolution.
    VtkFixedPoint,
    /// vtk.js' rule, on image resolution.
    VtkJs,
    /// Unreal's dynamic resolution heuristic, on image resolution.
    Unreal,
    /// Filament's feedback, on image resolution.
    Filament,
}

entire_core::names! { ControllerKind:
    Fixed "fixed",
    Olp "olp",
    Last "last",
    LargerOfTwo "larger-of-two",
    Pid "pid",
    Algorithm1 "algorithm1",
    Hybrid "hybrid",
    VtkGpu "vtk-gpu",
    VtkFixedPoint "vtk-fixed-point",
    VtkJs "vtk-js",
    Unreal "unreal",
    Filament "filament",
}

impl ControllerKind {
    /// The controllers that are compared by default.
    pub(crate) const DEFAULT_SET: [Self; 7] =
        [Self::Fixed, Self::Olp, Self::Last, Self::LargerOfTwo, Self::Pid, Self::Algorithm1, Self::Hybrid];

    /// The title in charts and tables.
    pub const fn title(self) -> &'static str {
        self.title_and_color().0
    }

    /// Color of controllers without one of their own.
    pub(crate) const OTHER_COLOR: usize = 9;

    /// Returns the title, and the index of the color in the palette of [`entire_report`], the same in all
    /// charts.
    pub(crate) const fn title_and_color(self) -> (&'static str, usize) {
        match self {
            Self::Fixed => ("fixed step", 5),
            Self::Olp => ("OLP (mean of 3)", 1),
            Self::Last => ("last frame", Self::OTHER_COLOR),
            Self::LargerOfTwo => ("larger of 2", 8),
            Self::Pid => ("PID", 3),
            Self::Algorithm1 => ("Algorithm 1", 2),
            Self::Hybrid => ("entire", 0),
            Self::VtkGpu => ("VTK GPU", 4),
            Self::VtkFixedPoint => ("VTK fixed-point", 7),
            Self::VtkJs => ("vtk.js", 6),
            Self::Unreal => ("Unreal", 8),
            Self::Filament => ("Filament", Self::OTHER_COLOR),
        }
    }

    /// Returns the quantity that the controller sets, with the range of the original rule: image sample
    /// distances up to 10 (VTK) and 20 pixels (vtk.js), image sides of at least half the full length (Unreal
    /// and Filament).
    pub const fn acts_on(self) -> ActsOn {
        match self {
            Self::VtkFixedPoint => ActsOn::ImageResolution { coarsest: 100.0 },
            Self::VtkJs => ActsOn::ImageResolution { coarsest: 400.0 },
            Self::Unreal | Self::Filament => ActsOn::ImageResolution { coarsest: 4.0 },
            _ => ActsOn::RayStep,
        }
    }

    /// True if the controller chooses the number of pixels between rays in addition to the ray step.
    pub(crate) fn chooses_image_sample_distance(self) -> bool {
        self == Self::Hybrid
    }

    /// Returns the controller with this name; `None` for an unknown name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::value_variants().iter().copied().find(|k| k.name() == name)
    }
}

/// Returns a new controller. `fixed_step` is the step of [`ControllerKind::Fixed`]; `response` is the curve
/// of frame time over step (the paper's G); `log_sd` is the predictor's error on this machine
/// ([`HybridOptions::log_sd`]).
pub fn controller(
    kind: ControllerKind,
    fixed_step: f32,
    response: &StepResponse,
    log_sd: Option<f32>,
) -> Box<dyn Controller + Send> {
    match kind {
        ControllerKind::Fixed => Box::new(Fixed { step: fixed_step }),
        ControllerKind::Olp => Box::new(Olp::new(Recent::MeanOfThree, response.clone())),
        ControllerKind::Last => Box::new(Olp::new(Recent::Last, response.clone())),
        ControllerKind::LargerOfTwo => Box::new(Olp::new(Recent::LargerOfTwo, response.clone())),
        ControllerKind::Pid => Box::new(Reactive(Pid::START)),
        ControllerKind::Algorithm1 => Box::new(Algorithm1 { response: response.clone() }),
        ControllerKind::Hybrid => HybridOptions { log_sd, ..HybridOptions::default() }.controller(),
        ControllerKind::VtkGpu => Box::new(Reactive(VtkGpu::START)),
        ControllerKind::VtkFixedPoint => Box::new(Reactive(VtkFixedPoint::START)),
        ControllerKind::VtkJs => Box::new(Reactive(VtkJs::START)),
        ControllerKind::Unreal => Box::new(Reactive(Unreal::START)),
        ControllerKind::Filament => Box::new(Reactive(Filament::START)),
    }
}

/// Returns PID with these proportional, integral and differential gains instead of [`PID_GAINS`].
///
/// [`PID_GAINS`]: super::rivals::PID_GAINS
pub fn pid(gains: [f32; 3]) -> Box<dyn Controller + Send> {
    Box::new(Reactive(Pid::with_gains(gains)))
}

/// Returns a contender before its first frame: a controller (see [`controller`]) with its own predictor.
pub fn contender(
    kind: ControllerKind,
    fixed_step: f32,
    predictor: Box<dyn Predictor + Send>,
    response: &StepResponse,
    log_sd: Option<f32>,
) -> Contender {
    let controller = controller(kind, fixed_step, response, log_sd);
    Contender {
        name: kind.name().into(),
        session: Session::with_controller(predictor, controller),
        chooses_image_sample_distance: kind.chooses_image_sample_distance(),
        acts_on: kind.acts_on(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_steer::control::StepLimits;

    #[test]
    fn names_are_those_of_the_options() {
        for kind in ControllerKind::value_variants() {
            let option = kind.to_possible_value().unwrap();
            assert_eq!(option.get_name(), kind.name());
            assert_eq!(ControllerKind::from_name(kind.name()), Some(*kind));
        }
        assert_eq!(ControllerKind::from_name("nobody"), None);
    }

    #[test]
    fn rules_that_scale_the_image_have_a_range_of_their_own() {
        let of_step = StepLimits { finest: 0.5, coarsest: 16.0 };
        for kind in ControllerKind::value_variants() {
            let acts_on = kind.acts_on();
            let limits = acts_on.limits(of_step);
            limits.check().unwrap();
            let (step, distance) = acts_on.drawn(limits.coarsest);
            match acts_on {
                ActsOn::RayStep => assert_eq!((limits, step, distance), (of_step, 16.0, 1.0)),
                ActsOn::ImageResolution { .. } => assert_eq!((limits.finest, step), (1.0, 1.0)),
            }
        }
        let distance = |kind: ControllerKind| kind.acts_on().drawn(kind.acts_on().limits(of_step).coarsest).1;
        assert_eq!(distance(ControllerKind::VtkFixedPoint), 10.0);
        assert_eq!(distance(ControllerKind::VtkJs), 20.0);
        assert_eq!((distance(ControllerKind::Unreal), distance(ControllerKind::Filament)), (2.0, 2.0));
    }
}
