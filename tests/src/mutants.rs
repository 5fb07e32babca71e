//! Structure-aware mutants of model files. Every file states the right length of its header; the header and
//! the data after it may be wrong in ways that a reader must detect. Random byte changes rarely give such
//! files, since they break the stated length.

use entire_core::kernels::Executor;
use entire_core::model::{GroupKind, Key, Model};
use entire_core::nn::{PredNet, VolumeNet, VolumeNetParts};
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, Scalars, VolumeView};
use entire_steer::features::{Changes, FrameFeatures, Setting};
use entire_steer::predict::{Inputs, Prediction, check_predictions, load};
use serde_json::{Map, Value, json};

/// Largest number of multiplications for which an encoding is run. An encoder that needs more is built but
/// not run.
pub const MOST_WORK: u128 = 20_000_000;

/// Largest size of a tensor of a generated network, in bytes.
const MOST_TENSOR: usize = 1 << 18;

/// A tensor of a file that is being mutated.
#[derive(Clone, Debug)]
struct Tensor {
    name: String,
    dtype: String,
    shape: Vec<u64>,
    data: Vec<u8>,
    /// Offsets that are written in place of the real ones.
    offsets: Option<[u64; 2]>,
}

/// The parts of a model file.
#[derive(Clone, Debug, Default)]
struct Parts {
    metadata: Map<String, Value>,
    tensors: Vec<Tensor>,
    /// Raw text that is written in place of the header.
    header: Option<String>,
}

impl Parts {
    fn read(bytes: &[u8]) -> Self {
        let (length, rest) = bytes.split_first_chunk::<8>().expect("a model file");
        let (header, data) = rest.split_at(u64::from_le_bytes(*length) as usize);
        let Value::Object(mut header) = serde_json::from_slice(header).expect("a header") else {
            panic!("the header is no object")
        };
        let metadata = match header.remove("__metadata__") {
            Some(Value::Object(metadata)) => metadata,
            _ => Map::new(),
        };
        let tensors = header.into_iter().map(|(name, info)| {
            let number = |v: &Value| v.as_u64().expect("a whole number");
            let [start, end] = [0, 1].map(|i| number(&info["data_offsets"][i]) as usize);
            Tensor {
                name,
                dtype: info["dtype"].as_str().expect("a type").into(),
                shape: info["shape"].as_array().expect("a shape").iter().map(number).collect(),
                data: data[start..end].to_vec(),
                offsets: None,
            }
        });
        Self { metadata, tensors: tensors.collect(), header: None }
    }

    fn bytes(&self) -> Vec<u8> {
        let (mut header, mut data) = (Map::new(), Vec::new());
        header.insert("__metadata__".into(), Value::Object(self.metadata.clone()));
        for t in &self.tensors {
            let start = data.len() as u64;
            data.extend_from_slice(&t.data);
            let offsets = t.offsets.unwrap_or([start, data.len() as u64]);
            let info = json!({"dtype": t.dtype, "shape": t.shape, "data_offsets": offsets});
            header.insert(t.name.clone(), info);
        }
        let mut header = self.header.clone().unwrap_or_else(|| Value::Object(header).to_string());
        header.push_str(&" ".repeat(header.len().next_multiple_of(8) - header.len()));
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(header.as_bytes());
        bytes.extend_from_slice(&data);
        bytes
    }
}

/// A stream of random numbers (xorshift64*).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// The stream from an initial state, which must not be 0; the same state gives the same numbers.
    pub fn new(state: u64) -> Self {
        Self(state)
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// A number in [−1, 1).
    pub fn uniform(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    /// A number below `n`; 0 for an `n` of 0.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }
}

/// A stream of mutants; the same seed gives the same files.
#[derive(Clone, Debug)]
pub struct Mutants {
    random: Random,
    seeds: Vec<Parts>,
    /// True if the file has usable weights and strides except where a mutation changes them.
    calm: bool,
}

impl Mutants {
    /// Mutants of the given model files and of generated networks.
    ///
    /// # Panics
    /// When one of the files is no model file.
    pub fn new(seed: u64, files: &[Vec<u8>]) -> Self {
        let seeds = files.iter().map(|f| Parts::read(f)).collect();
        Self { random: Self::stream(seed), seeds, calm: true }
    }

    /// Starts the stream of another seed.
    pub fn reseed(&mut self, seed: u64) {
        self.random = Self::stream(seed);
    }

    fn stream(seed: u64) -> Random {
        Random::new((seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d) | 1)
    }

    fn below(&mut self, n: usize) -> usize {
        self.random.below(n)
    }

    fn one<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.below(of.len())]
    }

    /// A hostile size: small, at an edge, or near an overflow.
    fn size(&mut self) -> u64 {
        let small = self.below(20) as u64;
        let power = 1u64 << self.below(64);
        let wrap = (1 << self.one(&[31, 32, 40, 59, 60, 61, 62, 63])) + small;
        self.one(&[small, small, small, 64, 255, 512, 513, power, power - 1, power + small, wrap, u64::MAX])
    }

    fn float(&mut self) -> f32 {
        let any = f32::from_bits(self.random.bits() as u32);
        let huge = 3.0e38 * if self.below(2) == 0 { 1.0 } else { -1.0 };
        self.one(&[f32::NAN, f32::INFINITY, huge, huge, huge, any, 0.0, 1.0e-40, -1.0, 100.0])
    }

    fn floats(&mut self, n: usize) -> Vec<u8> {
        let (style, value) = (if self.calm { 3 } else { self.below(4) }, self.float());
        let each = |this: &mut Self| match style {
            0 => value,
            1 if this.below(50) == 0 => this.float(),
            2 => this.one(&[3.0e38, -3.0e38]),
            _ => (this.random.bits() % 2000) as f32 * 1.0e-4,
        };
        (0..n).flat_map(|_| each(self).to_le_bytes()).collect()
    }

    /// Adds a tensor of random weights.
    fn put(&mut self, parts: &mut Parts, name: String, shape: Vec<u64>) {
        let data = self.floats(shape.iter().product::<u64>() as usize);
        parts.tensors.push(Tensor { name, dtype: "F32".into(), shape, data, offsets: None });
    }

    /// Adds the tensors and the layout of an encoder with consistent sizes; input size, channels, kernels and
    /// strides are random.
    fn encoder(&mut self, parts: &mut Parts) {
        parts.tensors.retain(|t| !t.name.starts_with("volumenet."));
        let input = match self.below(3) {
            0 => 1 + self.below(16),
            1 => 1 + self.below(128),
            _ => self.one(&[1, 2, 127, 128, 256, 500, 511, 512, 513]),
        };
        let (mut edge, mut channels, mut layout) = (input, 1usize, Vec::new());
        for i in 0..1 + self.below(4) {
            let kernel = self.one(&[1, 1, 2, 3, 3, 5, 8]).min(edge.max(1));
            let padding = if self.below(8) == 0 { self.below(4) } else { self.below(kernel) };
            let padded = edge + 2 * padding;
            let stride = match self.below(if self.calm { 60 } else { 6 }) {
                0 => self.size(),
                1 => padded as u64,
                2 => (padded + 1) as u64,
                _ => 1 + self.below(4).min(padded.saturating_sub(1)) as u64,
            };
            let room = MOST_TENSOR / 4 / (channels * kernel.pow(3));
            let wide = if self.below(6) == 0 { 1 + self.below(4096) } else { 1 + self.below(20) };
            let outputs = wide.min(room.max(1));
            let name = format!("volumenet.encoder.{i}");
            let cubes = [outputs, channels, kernel, kernel, kernel].map(|n| n as u64);
            self.put(parts, format!("{name}.conv.weight"), cubes.to_vec());
            for part in ["weight", "bias", "running_mean", "running_var"] {
                self.put(parts, format!("{name}.bn.{part}"), vec![outputs as u64]);
            }
            layout.push(json!({"stride": stride, "padding": padding}));
            edge = (padded.saturating_sub(kernel) as u64 / stride.max(1)) as usize + 1;
            channels = outputs;
        }
        let flat = (edge as u64).pow(3) * channels as u64;
        let room = MOST_TENSOR as u64 / 4;
        let features = if flat < room { 1 + self.below((room / flat).min(300) as usize) as u64 } else { 1 };
        self.put(parts, "volumenet.fc.weight".into(), vec![features, flat.min(room)]);
        self.put(parts, "volumenet.fc.bias".into(), vec![features]);
        let layout = json!({"input": input, "blocks": layout}).to_string();
        parts.metadata.insert(Key::VolumeNet.into(), layout.into());
        parts.metadata.insert(Key::Format.into(), "1".into());
    }

    /// Adds a PredNet with consistent sizes; depth and widths are random.
    fn prednet(&mut self, parts: &mut Parts) {
        parts.tensors.retain(|t| !t.name.starts_with("prednet."));
        let mut width = 1 + self.below(40);
        let groups = match self.below(3) {
            0 => json!([{"name": "camera", "size": 3}, {"name": "x", "size": width}]),
            1 => json!([{"name": "camera", "size": 3}, {"name": "resolution", "size": 2},
                {"name": "transfer_function", "size": 3}, {"name": "volume_features", "size": width}]),
            _ => json!([{"name": "volume_features", "size": width}]),
        };
        width = groups
            .as_array()
            .expect("groups")
            .iter()
            .map(|g| g["size"].as_u64().expect("a size") as usize)
            .sum();
        let deep = if self.below(10) == 0 { 300 } else { 5 };
        let layers = 1 + self.below(deep);
        for i in 0..layers {
            let outputs = match self.below(8) {
                _ if i + 1 == layers => 1,
                0 => 1 + self.below((MOST_TENSOR / 4 / width).max(1)),
                _ => 1 + self.below(12),
            };
            self.put(parts, format!("prednet.{i}.weight"), vec![outputs as u64, width as u64]);
            self.put(parts, format!("prednet.{i}.bias"), vec![outputs as u64]);
            width = outputs;
        }
        parts.metadata.insert(Key::Inputs.into(), groups.to_string().into());
        parts.metadata.insert(Key::Target.into(), self.one(&["seconds", "log_seconds"]).into());
        parts.metadata.insert(Key::Format.into(), "1".into());
    }

    fn groups(&mut self, parts: &mut Parts) {
        let count = self.one(&[0, 1, 2, 6, 40, 1024, 1025, 20_000]);
        let same = self.below(2) == 0;
        let list: Vec<Value> = (0..count)
            .map(|i| {
                let size = if self.below(3) == 0 { self.size() } else { 1 + self.below(3) as u64 };
                json!({"name": if same && i > 0 { "g".into() } else { format!("g{i}") }, "size": size})
            })
            .collect();
        parts.metadata.insert(Key::Inputs.into(), Value::Array(list).to_string().into());
    }

    fn tensor(&mut self, parts: &mut Parts) {
        if parts.tensors.is_empty() {
            return;
        }
        let at = self.below(parts.tensors.len());
        let total: u64 = parts.tensors.iter().map(|t| t.data.len() as u64).sum();
        let kind = self.below(9);
        let (size, other) = (self.size(), self.below(parts.tensors.len()));
        let t = &mut parts.tensors[at];
        match kind {
            0 => {
                self.calm = false;
                t.data = self.floats(t.data.len() / 4);
            }
            1 if !t.shape.is_empty() => {
                let axis = self.below(t.shape.len());
                t.shape[axis] = size;
            }
            2 => t.shape = (0..self.below(7)).map(|_| self.size()).collect(),
            3 => t.dtype = self.one(&["F32", "F16", "BF16", "F64", "I64", "U8", "BOOL", "F99"]).into(),
            4 => t.offsets = Some([size, size.wrapping_add(t.data.len() as u64)]),
            // Offsets that overlap others, leave holes, or lie beyond the end.
            5 => t.offsets = Some([size % (total + 9), (size % (total + 9)) + t.data.len() as u64]),
            6 => t.offsets = Some([self.size(), self.size()]),
            7 => t.data.truncate(self.below(t.data.len().max(1))),
            _ => {
                let name = parts.tensors[other].name.clone();
                parts.tensors[at].name = match self.below(3) {
                    0 => name,
                    1 => format!("prednet.{}.weight", self.below(1_000_000)),
                    _ => format!("volumenet.encoder.{}.conv.weight", self.below(1_000_000)),
                };
            }
        }
    }

    fn metadata(&mut self, parts: &mut Parts) {
        let known: Vec<String> = parts.metadata.keys().cloned().collect();
        let key = match self.below(3) {
            0 => self.one(&[Key::Inputs, Key::Target, Key::VolumeNet, Key::SceneFeatures]).into(),
            1 => self.one(&[Key::Calibration, Key::UnitCosts, Key::CachedVoxels, Key::ProbeSide]).into(),
            _ if known.is_empty() => "x".into(),
            _ => known[self.below(known.len())].clone(),
        };
        let (deep, size) = (self.one(&[1, 100, 127, 128, 129, 100_000]), self.size());
        let value: Value = match self.below(8) {
            0 => "[".repeat(deep).into(),
            1 => format!("{}1{}", "[".repeat(deep), "]".repeat(deep)).into(),
            2 => format!("{}1{}", r#"{"input":"#.repeat(deep), "}".repeat(deep)).into(),
            3 => size.to_string().into(),
            4 => json!({"input": size, "blocks": vec![json!({"stride": size, "padding": self.size()}); 2]})
                .to_string()
                .into(),
            5 => "\u{0}\u{10ffff}é".into(),
            6 => json!({"level": 0.95, "log_factor": 1.0e30}).to_string().into(),
            _ => {
                parts.metadata.remove(&key);
                return;
            }
        };
        parts.metadata.insert(key, value);
    }

    /// Returns the bytes of the next mutant.
    pub fn next_file(&mut self) -> Vec<u8> {
        self.calm = self.below(3) > 0;
        let mut parts = match self.below(self.seeds.len() + 1) {
            0 => Parts::default(),
            i => self.seeds[i - 1].clone(),
        };
        match self.below(4) {
            0 => self.encoder(&mut parts),
            1 => self.prednet(&mut parts),
            2 => {
                self.encoder(&mut parts);
                self.prednet(&mut parts);
            }
            _ => {}
        }
        for _ in 0..self.one(&[0, 1, 1, 1, 2, 4]) {
            match self.below(8) {
                0 => self.groups(&mut parts),
                1 | 2 => self.metadata(&mut parts),
                3 if self.below(20) == 0 => {
                    let deep = self.one(&[100, 128, 100_000]);
                    parts.header = Some(format!("{}{}", "{\"__metadata__\":".repeat(deep), "[".repeat(deep)));
                }
                _ => self.tensor(&mut parts),
            }
        }
        let mut bytes = parts.bytes();
        if self.below(10) == 0 {
            // Flips bits after the length field, which stays right.
            for _ in 0..1 + self.below(4) {
                let at = 8 + self.below(bytes.len() - 8);
                bytes[at] ^= 1 << self.below(8);
            }
        }
        bytes
    }
}

/// Outcome of a mutant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// True if the file was read as a model.
    pub opened: bool,
    /// True if the file's network predicted a time.
    pub predicted: bool,
    /// True if the file's encoder was built.
    pub built: bool,
    /// True if the file's encoder encoded a volume.
    pub encoded: bool,
}

/// Opens a file and uses it as an application would: builds its networks, predicts one frame alone, in a
/// batch and through the predictor, and encodes a volume if the encoding takes at most [`MOST_WORK`]
/// multiplications.
///
/// # Panics
/// When an accepted file cannot be run, a time is not finite and positive, or an error has no message.
pub fn exercise(bytes: &[u8]) -> Outcome {
    let mut out = Outcome::default();
    let model = match Model::from_bytes(bytes) {
        Ok(model) => model,
        Err(error) => {
            assert!(!error.to_string().is_empty());
            return out;
        }
    };
    out.opened = true;
    let usable = |seconds: f32| assert!(seconds.is_finite() && seconds > 0.0, "{seconds} seconds");
    if let Some(parts) = model.prednet.as_ref() {
        let net = PredNet::new(parts).expect("a checked network can be built");
        let row = vec![100.0; net.inputs()];
        let mut scratch = net.scratch(1).expect("memory for one row");
        let mut seconds = [net.predict(&row, &mut scratch)];
        if check_predictions(&mut seconds).is_ok() {
            seconds.into_iter().for_each(usable);
            out.predicted = true;
        }
        let mut batch = [0.0; 2];
        let rows = [&row[..], &row[..]].concat();
        let mut scratch = net.scratch(2).expect("memory for two rows");
        net.predict_batch(Executor::Serial, &rows, &mut batch, std::slice::from_mut(&mut scratch))
            .expect("a batch that fits");
        if check_predictions(&mut batch).is_ok() {
            batch.into_iter().for_each(usable);
        }
        if let Ok(prediction) = predict(&model) {
            usable(prediction.seconds);
            assert!(!(prediction.upper < prediction.seconds), "{prediction:?}");
        }
    }
    if let Some(parts) = model.volumenet.as_ref() {
        let net = VolumeNet::new(parts).expect("a checked encoder can be built");
        out.built = true;
        if work(parts) <= MOST_WORK {
            let voxels: Vec<u8> = (0..125).map(|i| i * 2).collect();
            let view = VolumeView::new(Scalars::U8(&voxels), [5; 3]).expect("125 voxels");
            let mut features = vec![0.0; net.feature_len()];
            net.encode(&view, &mut net.scratch(), Executor::Serial, &mut features).expect("an encoding");
            out.encoded = true;
        }
    }
    out
}

/// Predicts a frame through the predictor that a session would use.
///
/// # Errors
/// When the model has no predictor, or its result is not a time.
pub fn predict(model: &Model) -> entire_core::Result<Prediction> {
    let camera = Camera::from_arcball(Arcball { rx: 10.0, ry: 20.0, dz: 2.0 }).expect("a camera");
    let frame = Frame::new(camera, 640, 480).expect("a frame");
    let volume_features = model.input_size(GroupKind::VolumeFeatures).map(|n| vec![0.5; n]);
    let lobe = GaussianLobe { center: 0.5, width: 0.1, height: 0.5 };
    let lobes = model.input_size(GroupKind::TransferFunction).map(|n| vec![lobe; n / 3]);
    let features = FrameFeatures::default();
    load(model)?.predict(&Inputs {
        features: &features,
        setting: Setting::from(&frame),
        changes: Changes::default(),
        camera: camera.to_arcball(),
        volume_features: volume_features.as_deref(),
        lobes: lobes.as_deref(),
    })
}

/// Returns the approximate number of multiplications of an encoding.
fn work(parts: &VolumeNetParts) -> u128 {
    let cube = |n: usize| (n as u128).pow(3);
    let blocks = parts.blocks.iter().map(|b| {
        // The voxels of each block's input count as well.
        cube(b.output_edge) * cube(b.kernel) * (b.inputs * b.outputs).max(16) as u128 + cube(b.input_edge)
    });
    cube(parts.input) + blocks.sum::<u128>()
}
