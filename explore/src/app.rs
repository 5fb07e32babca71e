//! The application: opens the window, handles its events, and decides the next work.

mod commands;
mod frame;
mod idle;

use crate::host::{Host, Options};
use crate::loading::{Load, Loading, Wake};
use crate::log::Log;
use crate::present::{Presenter, surface_extensions};
use crate::refine::Refinement;
use crate::scene::Scene;
use crate::screenshot::Screenshot;
use crate::script::Script;
use crate::state::{Command, State};
use crate::steering::Steer;
use anyhow::{Context, Result, anyhow, bail};
use egui::TextureId;
use entire_core::scene::{Shading, Skipping};
use entire_vk_raycaster::{Picture, Renderer, SharedDevice, VulkanOptions, VulkanRaycaster};
use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::window::{Window, WindowId};

/// Texture ids that the interface uses until they are replaced by the ids of the pictures:
/// [`STEERED_TEXTURE`] for the picture of the last planned frame, [`FULL_QUALITY_TEXTURE`] for the picture at
/// full quality.
pub(crate) const STEERED_TEXTURE: TextureId = TextureId::User(u64::MAX);
pub(crate) const FULL_QUALITY_TEXTURE: TextureId = TextureId::User(u64::MAX - 1);

/// Time after a loss of the device within which another loss is fatal.
const LOST_AGAIN: Duration = Duration::from_secs(10);

/// The pictures on the device.
struct Pictures {
    steered: Picture,
    full: Picture,
    /// Texture ids in the interface's renderer.
    steered_id: TextureId,
    full_id: TextureId,
    size: [u32; 2],
    /// Size of the used part of `steered`, pixels.
    used: [u32; 2],
}

/// Event that a script waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Waiting {
    Nothing,
    Volume,
    Rest,
    Screenshot,
}

// Rust drops the fields in this order: objects of the device, then the device, then the window.
struct App {
    loading: Option<Loading>,
    scene: Option<Scene>,
    pictures: Option<Pictures>,
    presenter: Option<Presenter>,
    device: Option<SharedDevice>,
    vulkan: VulkanOptions,
    egui: egui::Context,
    /// Changes of the interface's textures that no frame has shown yet.
    textures: egui::TexturesDelta,
    input: Option<egui_winit::State>,
    window: Option<Window>,

    options: Options,
    host: Arc<dyn Host>,
    proxy: EventLoopProxy<Wake>,
    state: State,
    refinement: Option<Refinement>,
    /// True if the picture of the view is at full quality, or if its refinement failed.
    refined: bool,
    screenshot: Option<Screenshot>,
    script: Option<Script>,
    waiting: Waiting,
    log: Option<Log>,
    /// Number of drawn frames, and number of pictures that the window has shown.
    number: u64,
    shown: u64,
    /// Value of `shown` at the oldest input event that no shown picture includes yet.
    event_at: Option<u64>,
    last_change: Instant,
    last_paint: Instant,
    repaint_at: Option<Instant>,
    /// Time of the request for the present volume; `None` once its first frame is drawn.
    asked: Option<Instant>,
    swapped: Instant,
    /// Shading and skipping modes whose shaders are compiled.
    warm: HashSet<(Shading, Skipping)>,
    lost: Option<Instant>,
    failed: Option<anyhow::Error>,
}

/// Returns the text of an error: no `what` has the name `name`. The text lists the names in `known`.
fn unknown(what: &str, name: &str, known: impl IntoIterator<Item = &'static str>) -> String {
    let known: Vec<&str> = known.into_iter().collect();
    format!("there is no {what} {name:?}; there are {}", known.join(", "))
}

/// Returns the index of the controller of a given name.
fn controller_of(controllers: &[(&'static str, &'static str)], name: &str) -> Result<usize> {
    let found = controllers.iter().position(|c| c.0 == name);
    found.with_context(|| unknown("controller", name, controllers.iter().map(|c| c.0)))
}

/// Opens the window and returns once it is closed.
///
/// # Errors
/// When there is no display, no device can show pictures on it, or a script fails.
pub fn run(options: Options, host: Arc<dyn Host>) -> Result<()> {
    let controllers = host.controllers();
    let controller = controller_of(&controllers, &options.controller)?;
    let steer = Steer::new(controllers, controller, options.target);
    let script = options.script.as_deref().map(Script::open).transpose()?;
    if script.is_some() && options.volumes.is_empty() {
        bail!("a script needs an initial volume; give a volume file");
    }
    let log = options.log.as_deref().map(Log::create).transpose()?;
    let event_loop = EventLoop::<Wake>::with_user_event().build().map_err(|e| {
        anyhow!(
            "no window can be opened: {e}; set DISPLAY (X11) or WAYLAND_DISPLAY, or use a virtual \
             display: `xvfb-run -s '-screen 0 1280x900x24' entire explore …`; `entire render` and `entire \
             steer` need no display"
        )
    })?;
    let now = Instant::now();
    let mut app = App {
        loading: None,
        scene: None,
        pictures: None,
        presenter: None,
        device: None,
        vulkan: VulkanOptions::from_env()?,
        egui: egui::Context::default(),
        textures: egui::TexturesDelta::default(),
        input: None,
        window: None,
        state: State::new(&options, steer),
        proxy: event_loop.create_proxy(),
        waiting: if script.is_some() { Waiting::Volume } else { Waiting::Nothing },
        options,
        host,
        refinement: None,
        refined: false,
        screenshot: None,
        script,
        log,
        number: 0,
        shown: 0,
        event_at: None,
        last_change: now,
        last_paint: now,
        repaint_at: None,
        asked: None,
        swapped: now,
        warm: HashSet::new(),
        lost: None,
        failed: None,
    };
    let ended = event_loop.run_app(&mut app);
    // egui checks that no change of a texture is lost. After the last frame, these changes are not needed.
    app.textures.clear();
    ended.map_err(|e| anyhow!("the window's events cannot be read: {e}"))?;
    // Messages of the validation layer, if it is enabled.
    let said = app.device.as_ref().map(SharedDevice::validation_messages).unwrap_or_default();
    if let Some(error) = app.failed.take() {
        return Err(error);
    }
    if let Some(first) = said.first() {
        bail!("the validation layer reported {} messages, the first: {first}", said.len());
    }
    Ok(())
}

impl App {
    /// Opens the window, if there is none, and the device.
    fn open(&mut self, event_loop: &ActiveEventLoop) -> Result<()> {
        if self.window.is_none() {
            let (width, height) = self.options.size;
            let attributes = Window::default_attributes()
                .with_title("entire explore")
                .with_inner_size(PhysicalSize::new(width, height))
                .with_min_inner_size(PhysicalSize::new(480, 360));
            let window = event_loop.create_window(attributes).context("the window cannot be opened")?;
            self.input = Some(input(&self.egui, &window));
            self.window = Some(window);
        }
        self.open_device()?;
        if self.scene.is_none() && self.loading.is_none() && !self.state.series.is_empty() {
            self.load(self.state.series[0].clone())?;
        }
        Ok(())
    }

    fn open_device(&mut self) -> Result<()> {
        let window = self.window.as_ref().context("there is no window")?;
        self.vulkan.surface_extensions = surface_extensions(window)?;
        let first = VulkanRaycaster::new(self.vulkan.clone()).context("the window needs a Vulkan device")?;
        let device = first.shared_device();
        self.state.device = first.device();
        // Smoothed edges double the number of triangles, which is slow on software drivers.
        let software = first.limits().is_some_and(|limits| limits.is_software);
        self.egui.tessellation_options_mut(|options| options.feathering = !software);
        drop(first);
        let presenter = Presenter::new(&device, window)?;
        if let Some(input) = &mut self.input {
            input.set_max_texture_side(device.max_image_side() as usize);
        }
        (self.presenter, self.device) = (Some(presenter), Some(device));
        window.request_redraw();
        Ok(())
    }

    /// True if the device is open and was lost.
    fn is_lost(&self) -> bool {
        self.device.as_ref().is_some_and(SharedDevice::is_lost)
    }

    /// Opens the device and all its objects again after the device was lost. If a volume was being loaded,
    /// the loading starts again. Otherwise, the present volume, which is still in host memory, is uploaded
    /// again.
    fn recover(&mut self) -> Result<()> {
        if self.lost.is_some_and(|at| at.elapsed() < LOST_AGAIN) {
            bail!(
                "the device was lost again; see the driver's log, or choose another device (ENTIRE_DEVICE)"
            );
        }
        self.lost = Some(Instant::now());
        let loading = self.loading.take().inspect(Loading::cancel);
        let again = match self.scene.take() {
            Some(scene) if loading.is_none() => Some(Load {
                source: Some(scene.whole),
                range: scene.range,
                crop: scene.crop,
                curve: Some(self.state.edited.curve.clone()),
                ..self.job(scene.path, scene.index)
            }),
            _ => loading.map(|loading| loading.job),
        };
        // A screenshot is in the host's memory and continues once the volume is on the device again.
        (self.refinement, self.pictures) = (None, None);
        (self.presenter, self.device) = (None, None);
        self.state.picture = None;
        self.warm.clear();
        // The fonts are textures of the lost device, so the interface is rebuilt.
        self.egui = egui::Context::default();
        self.textures.clear();
        if let Some(window) = &self.window {
            self.input = Some(input(&self.egui, window));
        }
        self.open_device()?;
        self.state.say("the device was lost and is open again");
        again.map_or(Ok(()), |job| self.start(job))
    }

    /// Returns the job that loads a whole volume file in the current modes, with a preset as transfer
    /// function.
    fn job(&self, path: PathBuf, index: usize) -> Load {
        let (shading, skipping) = (self.state.shading, self.state.skipping);
        Load { path, index, shading, skipping, ..Load::default() }
    }

    /// Starts a load; a running load is canceled.
    fn start(&mut self, job: Load) -> Result<()> {
        let device = self.device.as_ref().context("there is no device")?;
        if let Some(before) = self.loading.take() {
            before.cancel();
        }
        self.loading = Some(Loading::start(job, &self.host, device, &self.vulkan, self.proxy.clone())?);
        self.redraw();
        Ok(())
    }

    fn redraw(&self) {
        if let Some(window) = &self.window {
            window.request_redraw();
        }
    }

    /// True if a script plays and does not wait for anything.
    fn is_scripted(&self) -> bool {
        self.script.is_some() && self.waiting == Waiting::Nothing
    }

    /// Handles an error: reopens a lost device, shows any other error. Closes the window if the device cannot
    /// be reopened, or if any other error occurs while a script plays or before the window can show pictures.
    fn deal_with(&mut self, result: Result<()>, event_loop: &ActiveEventLoop) {
        let Err(error) = result else { return };
        let is_lost = self.is_lost();
        let error = if is_lost {
            match self.recover() {
                Ok(()) => return,
                Err(again) => again,
            }
        } else {
            error
        };
        if is_lost || self.presenter.is_none() || self.script.is_some() {
            self.failed = Some(error);
            event_loop.exit();
        } else {
            self.state.complain(&error);
            // The failed frame was not shown, so another frame must show the message.
            self.repaint_at = Some(Instant::now() + idle::SHOW_EVERY);
            if self.screenshot.is_none() {
                // The refinement that failed is not tried again; the view keeps the part that is finished.
                (self.refined, self.refinement) = (true, None);
                self.state.rest = self.state.rest.filter(|rest| rest.took.is_some());
            }
            self.end_screenshot();
        }
    }
}

/// Returns the input state of a window, and sets the dark theme of its interface.
fn input(egui: &egui::Context, window: &Window) -> egui_winit::State {
    egui.set_theme(egui::Theme::Dark);
    let scale = window.scale_factor() as f32;
    egui_winit::State::new(egui.clone(), egui::ViewportId::ROOT, window, Some(scale), window.theme(), None)
}

impl ApplicationHandler<Wake> for App {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.presenter.is_none() {
            let opened = self.open(event_loop);
            self.deal_with(opened, event_loop);
        }
    }

    fn user_event(&mut self, _: &ActiveEventLoop, _: Wake) {
        self.redraw();
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let (Some(window), Some(input)) = (&self.window, &mut self.input) else { return };
        match &event {
            WindowEvent::RedrawRequested => {
                let drawn = self.frame(event_loop);
                self.deal_with(drawn, event_loop);
                return;
            }
            WindowEvent::CloseRequested => {
                event_loop.exit();
                return;
            }
            WindowEvent::DroppedFile(path) => self.state.commands.push(Command::Open(path.clone())),
            _ => {}
        }
        if input.on_window_event(window, &event).repaint {
            self.event_at.get_or_insert(self.shown);
            window.request_redraw();
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        if self.state.quit {
            event_loop.exit();
        }
        if self.presenter.is_none() || event_loop.exiting() {
            return;
        }
        let flow = self.idle();
        match flow {
            Ok(flow) => event_loop.set_control_flow(flow),
            Err(error) => {
                event_loop.set_control_flow(ControlFlow::Poll);
                self.deal_with(Err(error), event_loop);
                self.redraw();
            }
        }
    }
}
