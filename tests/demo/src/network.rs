//! A stereo network that was never trained, in ONNX form: plain block matching, written as a graph. It stands in for
//! the network that a user brings, so that the mode `neural` can be seen to run.
//!
//! Both images are halved twice; the absolute difference at each of [`DISPARITIES`] shifts is averaged over a window,
//! and the disparity is the mean of the shifts, weighted by how well they fit (a "soft argmin", Kendall et al. 2017,
//! arXiv 1703.04309), brought back to full size.

use prost::Message;

/// Shifts at a quarter of the size: 80 pixels at full size.
const DISPARITIES: i64 = 20;
/// Pixels that are averaged into one, in either direction.
const SHRINK: i64 = 4;
/// Side of the window that is matched, at a quarter of the size.
const WINDOW: i64 = 7;
/// How sharply the best shift wins, per grey level.
const SHARPNESS: f32 = 1.2;
/// The cost of a shift that leads out of the right image.
const OUTSIDE: f32 = 64.0;

/// The network for images of this width and height: inputs `left` and `right`, grey, 0 to 255; output `disparity`,
/// pixels.
pub fn block_matching(width: u32, height: u32) -> Vec<u8> {
    let w = i64::from(width);
    let h = i64::from(height);
    let small_w = w / SHRINK;
    let mut g = Graph::default();
    let pool = [ints("kernel_shape", &[SHRINK; 2]), ints("strides", &[SHRINK; 2])];
    let left = g.node("AveragePool", &["left"], &pool);
    let right = g.node("AveragePool", &["right"], &pool);
    let axes = g.int64s(&[3]);
    let zero = g.int64s(&[0]);
    let outside = g.floats(&[], &[OUTSIDE]);
    let mut costs = Vec::new();
    for d in 0..DISPARITIES {
        // The right image at x - d matches the left one at x; the first d columns have no partner.
        let from = g.int64s(&[d]);
        let to = g.int64s(&[small_w]);
        let till = g.int64s(&[small_w - d]);
        let l = g.node("Slice", &[&left, &from, &to, &axes], &[]);
        let r = g.node("Slice", &[&right, &zero, &till, &axes], &[]);
        let difference = g.node("Sub", &[&l, &r], &[]);
        let cost = g.node("Abs", &[&difference], &[]);
        let pads = g.int64s(&[0, 0, 0, d, 0, 0, 0, 0]);
        costs.push(g.node("Pad", &[&cost, &pads, &outside], &[]));
    }
    let costs: Vec<&str> = costs.iter().map(String::as_str).collect();
    let volume = g.node("Concat", &costs, &[int("axis", 1)]);
    let window = [ints("kernel_shape", &[WINDOW; 2]), ints("pads", &[WINDOW / 2; 4])];
    let volume = g.node("AveragePool", &[&volume], &window);
    let sharpness = g.floats(&[], &[-SHARPNESS]);
    let scores = g.node("Mul", &[&volume, &sharpness], &[]);
    let weights = g.node("Softmax", &[&scores], &[int("axis", 1)]);
    let shifts: Vec<f32> = (0..DISPARITIES).map(|d| (d * SHRINK) as f32).collect();
    let shifts = g.floats(&[1, DISPARITIES, 1, 1], &shifts);
    let weighted = g.node("Mul", &[&weights, &shifts], &[]);
    let channels = g.int64s(&[1]);
    let small = g.node("ReduceSum", &[&weighted, &channels], &[int("keepdims", 1)]);
    let scales = g.floats(&[4], &[1.0, 1.0, SHRINK as f32, SHRINK as f32]);
    g.node("Resize", &[&small, "", &scales], &[text("mode", "linear")]);
    let mut graph = g.0;
    if let Some(last) = graph.node.last_mut() {
        last.output = vec!["disparity".to_owned()];
    }
    "block_matching".clone_into(&mut graph.name);
    graph.input = vec![image("left", w, h), image("right", w, h)];
    graph.output = vec![image("disparity", w, h)];
    let model = Model {
        ir_version: 9,
        producer_name: "depthrig demo".to_owned(),
        doc_string: "Block matching as a graph; never trained. A stand-in for a network that a user brings."
            .to_owned(),
        graph: Some(graph),
        opset_import: vec![OperatorSet { domain: String::new(), version: 18 }],
    };
    model.encode_to_vec()
}

#[derive(Default)]
struct Graph(GraphProto);

impl Graph {
    fn name(&self) -> String {
        format!("v{}", self.0.node.len() + self.0.initializer.len())
    }

    fn node(&mut self, op: &str, inputs: &[&str], attributes: &[Attribute]) -> String {
        let name = self.name();
        let input = inputs.iter().map(|i| (*i).to_owned()).collect();
        let output = vec![name.clone()];
        let attribute = attributes.to_vec();
        self.0.node.push(Node { input, output, name: name.clone(), op_type: op.to_owned(), attribute });
        name
    }

    fn tensor(&mut self, data_type: i32, dims: Vec<i64>, raw_data: Vec<u8>) -> String {
        let name = self.name();
        self.0.initializer.push(Tensor { dims, data_type, name: name.clone(), raw_data });
        name
    }

    fn int64s(&mut self, numbers: &[i64]) -> String {
        let bytes = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        self.tensor(INT64, vec![numbers.len() as i64], bytes)
    }

    fn floats(&mut self, dims: &[i64], numbers: &[f32]) -> String {
        self.tensor(FLOAT, dims.to_vec(), numbers.iter().flat_map(|n| n.to_le_bytes()).collect())
    }
}

fn int(name: &str, i: i64) -> Attribute {
    Attribute { name: name.to_owned(), i, r#type: 2, ..Attribute::default() }
}

fn ints(name: &str, ints: &[i64]) -> Attribute {
    Attribute { name: name.to_owned(), ints: ints.to_vec(), r#type: 7, ..Attribute::default() }
}

fn text(name: &str, s: &str) -> Attribute {
    Attribute { name: name.to_owned(), s: s.as_bytes().to_vec(), r#type: 3, ..Attribute::default() }
}

fn image(name: &str, width: i64, height: i64) -> ValueInfo {
    let dim = [1, 1, height, width].map(|dim_value| Dimension { dim_value }).to_vec();
    let tensor_type = Some(TensorType { elem_type: FLOAT, shape: Some(Shape { dim }) });
    ValueInfo { name: name.to_owned(), r#type: Some(Type { tensor_type }) }
}

// The messages, as far as they are needed: github.com/onnx/onnx, onnx/onnx.proto (Apache-2.0), field numbers alone.

/// `TensorProto.DataType`.
const FLOAT: i32 = 1;
const INT64: i32 = 7;

#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(string, tag = "2")]
    producer_name: String,
    #[prost(string, tag = "6")]
    doc_string: String,
    #[prost(message, optional, tag = "7")]
    graph: Option<GraphProto>,
    #[prost(message, repeated, tag = "8")]
    opset_import: Vec<OperatorSet>,
}

#[derive(Clone, PartialEq, Message)]
struct OperatorSet {
    #[prost(string, tag = "1")]
    domain: String,
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Clone, PartialEq, Message)]
struct GraphProto {
    #[prost(message, repeated, tag = "1")]
    node: Vec<Node>,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    output: Vec<ValueInfo>,
}

#[derive(Clone, PartialEq, Message)]
struct Node {
    #[prost(string, repeated, tag = "1")]
    input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
    #[prost(string, tag = "3")]
    name: String,
    #[prost(string, tag = "4")]
    op_type: String,
    #[prost(message, repeated, tag = "5")]
    attribute: Vec<Attribute>,
}

#[derive(Clone, PartialEq, Message)]
struct Attribute {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(int64, tag = "3")]
    i: i64,
    #[prost(bytes = "vec", tag = "4")]
    s: Vec<u8>,
    #[prost(int64, repeated, tag = "8")]
    ints: Vec<i64>,
    #[prost(int32, tag = "20")]
    r#type: i32,
}

#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int64, repeated, tag = "1")]
    dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    data_type: i32,
    #[prost(string, tag = "8")]
    name: String,
    #[prost(bytes = "vec", tag = "9")]
    raw_data: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct ValueInfo {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    r#type: Option<Type>,
}

#[derive(Clone, PartialEq, Message)]
struct Type {
    #[prost(message, optional, tag = "1")]
    tensor_type: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorType {
    #[prost(int32, tag = "1")]
    elem_type: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<Shape>,
}

#[derive(Clone, PartialEq, Message)]
struct Shape {
    #[prost(message, repeated, tag = "1")]
    dim: Vec<Dimension>,
}

#[derive(Clone, PartialEq, Message)]
struct Dimension {
    #[prost(int64, tag = "1")]
    dim_value: i64,
}
