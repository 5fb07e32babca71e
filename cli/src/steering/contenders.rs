//! The controllers that commands can name.

use super::play::Contender;
use super::rivals::{Algorithm1, Filament, Olp, Pid, StepResponse, Unreal, VtkFixedPoint, VtkGpu, VtkJs};
use clap::ValueEnum;
use entire_core::adapt::Prior;
use entire_core::control::{Controller, Fixed, Hybrid, HybridOptions, Session};
use entire_core::predict::Predictor;

/// A controller by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, ValueEnum)]
pub enum ControllerKind {
    /// Always the same step.
    Fixed,
    /// Mean of the three frames before, brought to the reference step by G.
    Olp,
    /// Proportional, integral and differential feedback on the step, gains 0.3, 0.05, 0.1.
    Pid,
    /// The paper's: prediction at the reference step through G.
    Algorithm1,
    /// Ours: prediction for every step, corrected online, with a margin.
    Hybrid,
    /// VTK's rule for GPU ray casting.
    VtkGpu,
    /// VTK's rule for fixed-point ray casting.
    VtkFixedPoint,
    /// vtk.js' rule.
    VtkJs,
    /// Unreal's dynamic resolution heuristic, on the step.
    Unreal,
    /// Filament's feedback, on the step.
    Filament,
}

impl ControllerKind {
    /// The name used in options and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fixed => "fixed",
            Self::Olp => "olp",
            Self::Pid => "pid",
            Self::Algorithm1 => "algorithm1",
            Self::Hybrid => "hybrid",
            Self::VtkGpu => "vtk-gpu",
            Self::VtkFixedPoint => "vtk-fixed-point",
            Self::VtkJs => "vtk-js",
            Self::Unreal => "unreal",
            Self::Filament => "filament",
        }
    }

    /// The name for people.
    pub const fn title(self) -> &'static str {
        match self {
            Self::Fixed => "fixed step",
            Self::Olp => "OLP (mean of 3)",
            Self::Pid => "PID",
            Self::Algorithm1 => "Algorithm 1",
            Self::Hybrid => "hybrid (ours)",
            Self::VtkGpu => "VTK GPU",
            Self::VtkFixedPoint => "VTK fixed-point",
            Self::VtkJs => "vtk.js",
            Self::Unreal => "Unreal",
            Self::Filament => "Filament",
        }
    }

    /// By its name in tables.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::value_variants().iter().copied().find(|k| k.name() == name)
    }
}

/// A controller that has seen nothing. `fixed_step` is the step of [`ControllerKind::Fixed`]; `response` is
/// G; `prior` says how well the predictor is known on this machine.
pub fn controller(
    kind: ControllerKind,
    fixed_step: f32,
    response: &StepResponse,
    prior: Prior,
) -> Box<dyn Controller + Send> {
    match kind {
        ControllerKind::Fixed => Box::new(Fixed::new(fixed_step)),
        ControllerKind::Olp => Box::new(Olp::new(response.clone())),
        ControllerKind::Pid => Box::new(Pid::new(Pid::PAPER_GAINS)),
        ControllerKind::Algorithm1 => Box::new(Algorithm1::new(response.clone())),
        ControllerKind::Hybrid => Box::new(Hybrid::new(HybridOptions { prior, ..HybridOptions::default() })),
        ControllerKind::VtkGpu => Box::new(VtkGpu::new()),
        ControllerKind::VtkFixedPoint => Box::new(VtkFixedPoint::new()),
        ControllerKind::VtkJs => Box::new(VtkJs::new()),
        ControllerKind::Unreal => Box::new(Unreal::new()),
        ControllerKind::Filament => Box::new(Filament::new()),
    }
}

/// A contender: a controller (see [`controller`]) with a predictor of its own and nothing learned.
pub fn contender(
    kind: ControllerKind,
    fixed_step: f32,
    predictor: Box<dyn Predictor + Send>,
    response: &StepResponse,
    prior: Prior,
) -> Contender {
    let controller = controller(kind, fixed_step, response, prior);
    Contender {
        name: kind.name().into(),
        session: Session::with_controller(predictor, controller),
        chooses_image_sample_distance: kind == ControllerKind::Hybrid,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_options() {
        for kind in ControllerKind::value_variants() {
            let option = kind.to_possible_value().unwrap();
            assert_eq!(option.get_name(), kind.name());
            assert_eq!(ControllerKind::from_name(kind.name()), Some(*kind));
        }
        assert_eq!(ControllerKind::from_name("nobody"), None);
    }
}
