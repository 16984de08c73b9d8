//! The camera depth model, operation by operation.
//!
//! Written after the description of the network, with these identities, all of which hold exactly in real numbers:
//! - *Fusion.* Attention between the two tokens of a place is a softmax over two scores, which is a sigmoid of their
//!   difference: token `a` looks at the depth token with weight `σ(q_a · (k_d − k_r) / √h)`. Both results are summed,
//!   so with `w` the sum of the two weights the sum is `2 v_r + w (v_d − v_r)`. In `k_d − k_r` and `v_d − v_r` the
//!   biases cancel, so that both are projections of one difference of tokens.
//! - What follows is linear up to the head's first projection, so that the part of `v_r` goes into the weights that
//!   the colour token meets there; the product of the weights is of constants, and the engine computes it while it
//!   loads.
//! - A 1x1 convolution and an interpolation whose weights add up to 1 may change places; the smaller image comes
//!   first.
//! - The depth encoder's three input channels are the same image, so that its kernel can be summed over them.

use super::builder::{Attribute, Builder, CONTRIB, Dimension, Value};
use super::{Attention, Graph, Style};
use crate::arch::{Architecture, ENCODERS, FUSION_HEADS, FeedForward, HEAD, NORM_EPS, PATCH};
use Attribute::{Float, Int, Ints, Text};

/// As far as a slice can go.
const END: i64 = i64::MAX;

/// The network being built.
struct Net {
    g: Builder,
    arch: Architecture,
    style: Style,
}

/// The graph of a network of these sizes.
pub fn build(arch: Architecture, style: Style) -> Graph {
    let shapes = arch.tensors().into_iter().map(|t| (t.name, t.shape)).collect();
    let mut net = Net { g: Builder::new(shapes, style.numbers), arch, style };
    net.whole();
    net.g.finish("camera depth model")
}

impl Net {
    fn whole(&mut self) {
        use Dimension::{Fixed, Named};
        let height = Named("height");
        let width = Named("width");
        let x = self.g.input("x", &[Named("batch"), Fixed(4), height, width]);
        let rgb_positions = self.g.input("pos_rgb", &[Named("tokens"), Fixed(self.arch.width)]);
        let depth_positions = self.g.input("pos_depth", &[Named("tokens"), Fixed(self.arch.width)]);

        let batch = self.dims(&x, 0, 1);
        let size = self.dims(&x, 2, 4);
        let patch = self.g.ints(&[PATCH as i64]);
        let places = self.g.op("Div", &[&size, &patch], &[]);

        let x = self.g.cast(x);
        let rgb = self.columns(&x, 0, 3);
        let depth = self.columns(&x, 3, 4);
        let rgb = self.encoder(&rgb, rgb_positions, 0, &batch);
        let depth = self.encoder(&depth, depth_positions, 1, &batch);

        let levels: Vec<Value> = (0..self.arch.taps.len())
            .map(|level| {
                let tokens = self.fuse(level, &rgb[level], &depth[level]);
                self.level(level, &tokens, &batch, &places)
            })
            .collect();
        let y = self.head(&levels, &size);
        let axis = self.g.ints(&[1]);
        let y = self.g.op("Squeeze", &[&y, &axis], &[]);
        let y = self.g.uncast(y);
        self.g.output("y", &y, &[Named("batch"), height, width]);
    }

    // Small pieces.

    /// Dimensions `from..to` of `value`.
    fn dims(&mut self, value: &Value, from: i64, to: i64) -> Value {
        self.g.op("Shape", &[value], &[("start", Int(from)), ("end", Int(to))])
    }

    /// `value` along dimension 1, from `from` to `to`.
    fn columns(&mut self, value: &Value, from: i64, to: i64) -> Value {
        let from = self.g.ints(&[from]);
        let to = self.g.ints(&[to]);
        let axis = self.g.ints(&[1]);
        self.g.op("Slice", &[value, &from, &to, &axis], &[])
    }

    fn concat(&mut self, parts: &[&Value], axis: i64) -> Value {
        self.g.op("Concat", parts, &[("axis", Int(axis))])
    }

    fn reshape(&mut self, value: &Value, shape: &Value) -> Value {
        self.g.op("Reshape", &[value, shape], &[])
    }

    /// `value` as a matrix with rows as wide as a token.
    fn rows(&mut self, value: &Value) -> Value {
        let shape = self.g.ints(&[-1, self.arch.width as i64]);
        self.reshape(value, &shape)
    }

    fn transpose(&mut self, value: &Value, order: &[i64]) -> Value {
        self.g.op("Transpose", &[value], &[("perm", Ints(order))])
    }

    fn add(&mut self, a: &Value, b: &Value) -> Value {
        self.g.op("Add", &[a, b], &[])
    }

    fn mul(&mut self, a: &Value, b: &Value) -> Value {
        self.g.op("Mul", &[a, b], &[])
    }

    fn scale(&mut self, value: &Value, by: f64) -> Value {
        let by = self.g.float(by as f32);
        let by = self.g.cast(by);
        self.mul(value, &by)
    }

    /// `x Wᵀ + b`, with the weight as it lies in the checkpoint.
    fn gemm(&mut self, x: &Value, weight: &Value, bias: Option<&Value>) -> Value {
        let inputs: Vec<&Value> = [x, weight].into_iter().chain(bias).collect();
        self.g.op("Gemm", &inputs, &[("transB", Int(1))])
    }

    fn linear(&mut self, x: &Value, name: &str) -> Value {
        let weight = self.g.weight(&format!("{name}.weight"));
        let bias = self.g.weight(&format!("{name}.bias"));
        self.gemm(x, &weight, Some(&bias))
    }

    /// The part of a linear layer that gives outputs `part * width .. (part + 1) * width`.
    fn linear_part(
        &mut self,
        x: &Value,
        weight: &str,
        bias: Option<&str>,
        part: usize,
        width: usize,
    ) -> Value {
        let rows = part * width..(part + 1) * width;
        let weight = self.g.raw_rows(weight, rows.clone());
        let weight = self.g.cast(weight);
        let bias = bias.map(|bias| {
            let bias = self.g.raw_rows(bias, rows);
            self.g.cast(bias)
        });
        self.gemm(x, &weight, bias.as_ref())
    }

    fn norm(&mut self, x: &Value, name: &str) -> Value {
        let weight = self.g.weight(&format!("{name}.weight"));
        let bias = self.g.weight(&format!("{name}.bias"));
        let attributes = [("axis", Int(-1)), ("epsilon", Float(NORM_EPS as f32))];
        self.g.op("LayerNormalization", &[x, &weight, &bias], &attributes)
    }

    // The encoders.

    /// The tokens of the tapped blocks, normalised and without the class token, `[batch * places, width]`.
    fn encoder(&mut self, image: &Value, positions: Value, which: usize, batch: &Value) -> Vec<Value> {
        let name = ENCODERS[which];
        let x = self.tokens(image, positions, name, which == 1, batch);
        let shape = self.dims(&x, 0, 3);
        let head_shape = match self.style.attention {
            Attention::Fused => Value::none(),
            Attention::Standard => {
                let heads = self.g.ints(&[self.arch.heads as i64, self.arch.head_width() as i64]);
                let first_two = self.dims(&x, 0, 2);
                self.concat(&[&first_two, &heads], 0)
            }
        };

        let mut x = self.rows(&x);
        let mut taps = Vec::new();
        for i in 0..self.arch.blocks {
            let block = format!("{name}.blocks.{i}");
            let y = self.norm(&x, &format!("{block}.norm1"));
            let y = self.attention(&y, &format!("{block}.attn"), &shape, &head_shape);
            let scale = self.g.weight(&format!("{block}.ls1.gamma"));
            let y = self.mul(&y, &scale);
            x = self.add(&x, &y);

            let y = self.norm(&x, &format!("{block}.norm2"));
            let y = self.feed_forward(&y, &format!("{block}.mlp"));
            let scale = self.g.weight(&format!("{block}.ls2.gamma"));
            let y = self.mul(&y, &scale);
            x = self.add(&x, &y);

            if self.arch.taps.contains(&i) {
                let tokens = self.reshape(&x, &shape);
                let tokens = self.columns(&tokens, 1, END);
                let tokens = self.rows(&tokens);
                taps.push(self.norm(&tokens, &format!("{name}.norm")));
            }
        }
        taps
    }

    /// One token for each patch and the class token before them, with their positions: `[batch, tokens, width]`.
    fn tokens(
        &mut self,
        image: &Value,
        positions: Value,
        name: &str,
        one_channel: bool,
        batch: &Value,
    ) -> Value {
        let mut kernel = self.g.raw(&format!("{name}.patch_embed.proj.weight"));
        if one_channel {
            let axis = self.g.ints(&[1]);
            kernel = self.g.op("ReduceSum", &[&kernel, &axis], &[("keepdims", Int(1))]);
        }
        let kernel = self.g.cast(kernel);
        let bias = self.g.weight(&format!("{name}.patch_embed.proj.bias"));
        let edge = [PATCH as i64; 2];
        let attributes = [("kernel_shape", Ints(&edge)), ("strides", Ints(&edge))];
        let patches = self.g.op("Conv", &[image, &kernel, &bias], &attributes);
        let flat = self.g.ints(&[0, 0, -1]);
        let patches = self.reshape(&patches, &flat);
        let patches = self.transpose(&patches, &[0, 2, 1]);

        let one = self.g.ints(&[1, self.arch.width as i64]);
        let shape = self.concat(&[batch, &one], 0);
        let class = self.g.weight(&format!("{name}.cls_token"));
        let class = self.g.op("Expand", &[&class, &shape], &[]);
        let tokens = self.concat(&[&class, &patches], 1);
        let positions = self.g.cast(positions);
        self.add(&tokens, &positions)
    }

    /// Attention over all tokens of an image. `shape` is `[batch, tokens, width]`, `head_shape` the same with the
    /// width in heads.
    fn attention(&mut self, x: &Value, name: &str, shape: &Value, head_shape: &Value) -> Value {
        let weight = format!("{name}.qkv.weight");
        let bias = format!("{name}.qkv.bias");
        let [q, k, v] =
            [0, 1, 2].map(|part| self.linear_part(x, &weight, Some(&bias), part, self.arch.width));
        let scale = (self.arch.head_width() as f64).powf(-0.5);
        let y = match self.style.attention {
            Attention::Fused => {
                let [q, k, v] = [q, k, v].map(|t| self.reshape(&t, shape));
                let attributes = [("num_heads", Int(self.arch.heads as i64)), ("scale", Float(scale as f32))];
                self.g.op_in(CONTRIB, "MultiHeadAttention", &[&q, &k, &v], &attributes)
            }
            Attention::Standard => {
                let q = self.scale(&q, scale);
                let [q, k, v] = [q, k, v].map(|t| self.reshape(&t, head_shape));
                let q = self.transpose(&q, &[0, 2, 1, 3]);
                let v = self.transpose(&v, &[0, 2, 1, 3]);
                let k = self.transpose(&k, &[0, 2, 3, 1]);
                let scores = self.g.op("MatMul", &[&q, &k], &[]);
                let shares = self.g.op("Softmax", &[&scores], &[("axis", Int(-1))]);
                let y = self.g.op("MatMul", &[&shares, &v], &[]);
                self.transpose(&y, &[0, 2, 1, 3])
            }
        };
        let y = self.rows(&y);
        self.linear(&y, &format!("{name}.proj"))
    }

    fn feed_forward(&mut self, x: &Value, name: &str) -> Value {
        match self.arch.feed_forward {
            FeedForward::Gelu { .. } => {
                let y = self.linear(x, &format!("{name}.fc1"));
                let y = self.g.op("Gelu", &[&y], &[]);
                self.linear(&y, &format!("{name}.fc2"))
            }
            FeedForward::SwiGlu { hidden } => {
                let weight = format!("{name}.w12.weight");
                let bias = format!("{name}.w12.bias");
                let [a, b] = [0, 1].map(|part| self.linear_part(x, &weight, Some(&bias), part, hidden));
                let gate = self.g.op("Sigmoid", &[&a], &[]);
                let a = self.mul(&a, &gate);
                let y = self.mul(&a, &b);
                self.linear(&y, &format!("{name}.w3"))
            }
        }
    }

    // The fusion.

    /// From the tokens of both encoders to what the head's projection makes of them, `[batch * places, channels]`.
    fn fuse(&mut self, level: usize, rgb: &Value, depth: &Value) -> Value {
        let width = self.arch.width;
        let name = format!("crossAtts.{level}");
        let weight = format!("{name}.in_proj_weight");
        let bias = format!("{name}.in_proj_bias");
        let head = width / FUSION_HEADS;
        let heads = self.g.ints(&[-1, FUSION_HEADS as i64, head as i64]);

        let difference = self.g.op("Sub", &[depth, rgb], &[]);
        let [keys, values] = [1, 2].map(|part| {
            let y = self.linear_part(&difference, &weight, None, part, width);
            self.reshape(&y, &heads)
        });
        let [a, b] = [rgb, depth].map(|tokens| {
            let q = self.linear_part(tokens, &weight, Some(&bias), 0, width);
            let q = self.reshape(&q, &heads);
            let product = self.mul(&q, &keys);
            let axis = self.g.ints(&[2]);
            let score = self.g.op("ReduceSum", &[&product, &axis], &[("keepdims", Int(1))]);
            let score = self.scale(&score, (head as f64).powf(-0.5));
            self.g.op("Sigmoid", &[&score], &[])
        });
        let share = self.add(&a, &b);
        let mixed = self.mul(&values, &share);
        let mixed = self.rows(&mixed);

        let [for_rgb, for_mixed, bias] = self.fused_projection(level);
        let y = self.gemm(rgb, &for_rgb, Some(&bias));
        let z = self.gemm(&mixed, &for_mixed, None);
        self.add(&y, &z)
    }

    /// Constants: with `P` and `b` the projection of the head, its columns for colour and for fused tokens `P_r` and
    /// `P_f`, `O` and `o` the output projection of the attention and `V` and `v` its value projection, the weight of
    /// the colour token `P_r + 2 P_f O V`, that of the mixed values `P_f O`, and the bias `b + 2 P_f (O v + o)`.
    fn fused_projection(&mut self, level: usize) -> [Value; 3] {
        let width = self.arch.width;
        let channels = self.arch.levels[level];
        let name = format!("crossAtts.{level}");
        let values = 2 * width..3 * width;
        let projection = self.g.raw_as(&format!("{HEAD}.projects.{level}.weight"), &[channels, 2 * width]);
        let p_rgb = self.columns(&projection, 0, width as i64);
        let p_fused = self.columns(&projection, width as i64, END);
        let two = self.g.float(2.0);

        let out = self.g.raw(&format!("{name}.out_proj.weight"));
        let for_mixed = self.g.op("MatMul", &[&p_fused, &out], &[]);
        let twice = self.mul(&for_mixed, &two);
        let value = self.g.raw_rows(&format!("{name}.in_proj_weight"), values.clone());
        let through = self.g.op("MatMul", &[&twice, &value], &[]);
        let for_rgb = self.add(&p_rgb, &through);

        let value = self.g.raw_rows(&format!("{name}.in_proj_bias"), values);
        let of_value = self.g.op("MatMul", &[&twice, &value], &[]);
        let out = self.g.raw(&format!("{name}.out_proj.bias"));
        let of_out = self.g.op("MatMul", &[&p_fused, &out], &[]);
        let of_out = self.mul(&of_out, &two);
        let bias = self.g.raw(&format!("{HEAD}.projects.{level}.bias"));
        let bias = self.add(&bias, &of_value);
        let bias = self.add(&bias, &of_out);
        [for_rgb, for_mixed, bias].map(|constant| self.g.cast(constant))
    }

    // The head.

    fn conv(&mut self, x: &Value, name: &str, edge: i64, stride: i64, bias: bool) -> Value {
        let weight = self.g.weight(&format!("{name}.weight"));
        let bias = bias.then(|| self.g.weight(&format!("{name}.bias")));
        let kernel = [edge; 2];
        let strides = [stride; 2];
        let pads = [edge / 2; 4];
        let attributes =
            [("kernel_shape", Ints(&kernel)), ("strides", Ints(&strides)), ("pads", Ints(&pads))];
        let inputs: Vec<&Value> = [x, &weight].into_iter().chain(&bias).collect();
        self.g.op("Conv", &inputs, &attributes)
    }

    /// A transposed convolution whose steps are as wide as its kernel, so that nothing overlaps.
    fn grow(&mut self, x: &Value, name: &str, edge: i64) -> Value {
        let weight = self.g.weight(&format!("{name}.weight"));
        let bias = self.g.weight(&format!("{name}.bias"));
        let edge = [edge; 2];
        let attributes = [("kernel_shape", Ints(&edge)), ("strides", Ints(&edge))];
        self.g.op("ConvTranspose", &[x, &weight, &bias], &attributes)
    }

    fn relu(&mut self, x: &Value) -> Value {
        self.g.op("Relu", &[x], &[])
    }

    /// Bilinear to `size` (rows, columns), corners on corners.
    fn resize(&mut self, x: &Value, size: &Value) -> Value {
        let rest = self.dims(x, 0, 2);
        let sizes = self.concat(&[&rest, size], 0);
        let none = Value::none();
        let attributes =
            [("mode", Text("linear")), ("coordinate_transformation_mode", Text("align_corners"))];
        self.g.op("Resize", &[x, &none, &none, &sizes], &attributes)
    }

    /// One level of the head, as wide as all of them: 4, 2, 1 and 1/2 pixels for each place.
    fn level(&mut self, level: usize, tokens: &Value, batch: &Value, places: &Value) -> Value {
        let channels = self.g.ints(&[self.arch.levels[level] as i64]);
        let any = self.g.ints(&[-1]);
        let shape = self.concat(&[batch, &any, &channels], 0);
        let x = self.reshape(tokens, &shape);
        let x = self.transpose(&x, &[0, 2, 1]);
        let shape = self.concat(&[batch, &channels, places], 0);
        let x = self.reshape(&x, &shape);
        let name = format!("{HEAD}.resize_layers.{level}");
        let x = match level {
            0 => self.grow(&x, &name, 4),
            1 => self.grow(&x, &name, 2),
            2 => x,
            _ => self.conv(&x, &name, 3, 2, true),
        };
        self.conv(&x, &format!("{HEAD}.scratch.layer{}_rn", level + 1), 3, 1, false)
    }

    fn residual(&mut self, x: &Value, name: &str) -> Value {
        let y = self.relu(x);
        let y = self.conv(&y, &format!("{name}.conv1"), 3, 1, true);
        let y = self.relu(&y);
        let y = self.conv(&y, &format!("{name}.conv2"), 3, 1, true);
        self.add(&y, x)
    }

    fn head(&mut self, levels: &[Value], size: &Value) -> Value {
        let mut x: Option<Value> = None;
        for i in (0..levels.len()).rev() {
            let name = format!("{HEAD}.scratch.refinenet{}", i + 1);
            let sum = match &x {
                None => levels[i].clone(),
                Some(x) => {
                    let skip = self.residual(&levels[i], &format!("{name}.resConfUnit1"));
                    self.add(x, &skip)
                }
            };
            let y = self.residual(&sum, &format!("{name}.resConfUnit2"));
            let y = self.conv(&y, &format!("{name}.out_conv"), 1, 1, true);
            let to = if i == 0 {
                let own = self.dims(&y, 2, 4);
                let two = self.g.ints(&[2]);
                self.mul(&own, &two)
            } else {
                self.dims(&levels[i - 1], 2, 4)
            };
            x = Some(self.resize(&y, &to));
        }
        let x = x.unwrap_or_else(Value::none);
        let x = self.conv(&x, &format!("{HEAD}.scratch.output_conv1"), 3, 1, true);
        let x = self.resize(&x, size);
        let x = self.conv(&x, &format!("{HEAD}.scratch.output_conv2.0"), 3, 1, true);
        let x = self.relu(&x);
        let x = self.conv(&x, &format!("{HEAD}.scratch.output_conv2.2"), 1, 1, true);
        self.relu(&x)
    }
}
