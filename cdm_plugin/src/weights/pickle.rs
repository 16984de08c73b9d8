//! The pickles in which PyTorch keeps the names and places of tensors, read without running anything.
//!
//! A pickle is a program for a stack machine that may call any function of Python. Here only the operations that state
//! dicts are made of are understood, and only the few functions in [`Global`], which are recognised and not called. The
//! result is a table of values that refer to each other by number, so that nothing nests: deep or circular data can
//! exhaust no stack, and a pickle of n bytes makes at most n values.
//!
//! Operations: `pickletools.py` and `pickle.py` of CPython. What tensors are made of: `torch/_utils.py` and
//! `torch/serialization.py` of PyTorch.
//!
//! More than 500 lines, because the operations share one machine.

use super::{Dtype, Parsed};
use std::collections::HashMap;

/// The largest network with the state of its optimizer needs 1 MB.
pub(super) const MAX_BYTES: usize = 32 << 20;
const MAX_VALUES: usize = 4 << 20;
/// Tensors of the network have at most four dimensions.
const MAX_DIMENSIONS: usize = 8;

/// The place of a value in [`Pickle::values`].
pub(super) type Id = u32;

/// Type of the numbers in a storage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Element {
    /// Numbers that a network can use.
    Float(Dtype),
    /// Others: the name that PyTorch has for them.
    Other(&'static str),
}

/// A function or class that a pickle names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Global {
    /// `collections.OrderedDict`.
    OrderedDict,
    /// `torch._utils._rebuild_tensor_v2`: storage, offset, shape, strides, and more that does not matter.
    RebuildTensor,
    /// `torch._utils._rebuild_parameter`: a tensor, and more that does not matter.
    RebuildParameter,
    /// `torch.Size`: a tuple.
    Size,
    /// `torch.FloatStorage` and its like.
    Storage(Element),
    /// `torch.float32` and its like: known, and of no use here.
    Dtype,
}

/// Numbers in a member of the archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Storage<'a> {
    pub element: Element,
    /// The member's name under `data/`.
    pub key: &'a str,
    /// How many numbers.
    pub len: u64,
}

/// A view of a storage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Tensor<'a> {
    pub storage: Storage<'a>,
    /// Its first number.
    pub offset: u64,
    pub shape: Vec<usize>,
    /// Numbers from one index to the next, for each dimension.
    pub strides: Vec<u64>,
}

/// A value. Those inside others are named by their place in [`Pickle::values`].
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value<'a> {
    None,
    Bool,
    Int(i64),
    Float,
    /// An integer beyond 64 bits, or bytes.
    Opaque,
    Text(&'a str),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Global(Global),
    Storage(Storage<'a>),
    Tensor(Tensor<'a>),
}

impl Value<'_> {
    /// Name of the type in Python.
    pub(super) const fn kind(&self) -> &'static str {
        match self {
            Self::None => "None",
            Self::Bool => "a bool",
            Self::Int(_) => "an int",
            Self::Float => "a float",
            Self::Opaque => "bytes or a long int",
            Self::Text(_) => "a str",
            Self::Tuple(_) => "a tuple",
            Self::List(_) => "a list",
            Self::Dict(_) => "a dict",
            Self::Global(_) => "a class",
            Self::Storage(_) => "a storage",
            Self::Tensor(_) => "a tensor",
        }
    }
}

/// All the values of a pickle.
#[derive(Debug)]
pub(super) struct Pickle<'a> {
    pub values: Vec<Value<'a>>,
    /// The one that the pickle is about.
    pub root: Id,
}

impl<'a> Pickle<'a> {
    pub(super) fn get(&self, id: Id) -> &Value<'a> {
        self.values.get(id as usize).unwrap_or(&Value::None)
    }
}

/// Refuses a pickle that is too long to be read.
pub(super) fn check_size(bytes: usize) -> Parsed<()> {
    if bytes <= MAX_BYTES {
        return Ok(());
    }
    Err(format!("the list of its tensors has {bytes} bytes; {MAX_BYTES} is the most that is read here"))
}

/// Reads a pickle.
pub(super) fn read(bytes: &[u8]) -> Parsed<Pickle<'_>> {
    check_size(bytes.len())?;
    let mut machine = Machine {
        bytes,
        at: 0,
        values: Vec::new(),
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
    };
    let root = machine.run().map_err(|what| {
        format!("the list of its tensors (data.pkl) cannot be read at byte {}: {what}", machine.at)
    })?;
    Ok(Pickle { values: machine.values, root })
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    values: Vec<Value<'a>>,
    stack: Vec<Id>,
    /// How high the stack was at each mark.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
}

impl<'a> Machine<'a> {
    /// Runs to the end, and says which value the pickle is about.
    fn run(&mut self) -> Parsed<Id> {
        loop {
            let op = self.u8()?;
            if op == b'.' {
                return self.pop();
            }
            self.step(op)?;
        }
    }

    fn step(&mut self, op: u8) -> Parsed<()> {
        match op {
            0x80 => self.protocol()?,
            0x95 => drop(self.take(8)?), // a frame: only a hint for readers of streams
            b'(' => self.marks.push(self.stack.len()),
            // `b`: the state of an object. Dicts carry `_metadata`, with versions of layers that do not matter here.
            b'0' | b'b' => drop(self.pop()?),
            b'1' => drop(self.since_mark()?),
            b'N' => self.push(Value::None)?,
            0x88 | 0x89 => self.push(Value::Bool)?,
            b'K' => self.number(1)?,
            b'M' => self.number(2)?,
            b'J' => {
                let n = i32::from_le_bytes(self.array()?);
                self.push(Value::Int(n.into()))?;
            }
            0x8a => self.long()?,
            b'G' => {
                self.take(8)?;
                self.push(Value::Float)?;
            }
            b'X' | b'T' => self.text(4)?,
            0x8c | b'U' => self.text(1)?,
            0x8d => self.text(8)?,
            b'C' | b'B' => {
                let len = self.len(if op == b'C' { 1 } else { 4 })?;
                self.take(len)?;
                self.push(Value::Opaque)?;
            }
            b'}' => self.push(Value::Dict(Vec::new()))?,
            b']' | 0x8f => self.push(Value::List(Vec::new()))?, // 0x8f: a set
            b')' => self.push(Value::Tuple(Vec::new()))?,
            b't' => {
                let items = self.since_mark()?;
                self.push(Value::Tuple(items))?;
            }
            0x85..=0x87 => {
                let at = self.height(usize::from(op - 0x84))?;
                let items = self.stack.split_off(at);
                self.push(Value::Tuple(items))?;
            }
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' | 0x90 => {
                let items = self.since_mark()?;
                self.append(items)?;
            }
            b's' => {
                let at = self.height(2)?;
                let items = self.stack.split_off(at);
                self.set_items(&items)?;
            }
            b'u' => {
                let items = self.since_mark()?;
                self.set_items(&items)?;
            }
            b'q' => self.remember(1)?,
            b'r' => self.remember(4)?,
            0x94 => {
                let place = self.memo.len() as u32;
                let top = self.top()?;
                self.memo.insert(place, top);
            }
            b'h' => self.recall(1)?,
            b'j' => self.recall(4)?,
            b'c' => {
                let module = self.line()?;
                let name = self.line()?;
                self.global(module, name)?;
            }
            0x93 => {
                let name = self.pop_text()?;
                let module = self.pop_text()?;
                self.global(module, name)?;
            }
            b'Q' => self.persistent()?,
            b'R' | 0x81 => self.call()?,
            other => return Err(unknown(other)),
        }
        Ok(())
    }

    fn protocol(&mut self) -> Parsed<()> {
        match self.u8()? {
            2..=5 => Ok(()),
            other => Err(format!("it is of protocol {other}; 2 to 5 are known")),
        }
    }

    fn take(&mut self, n: usize) -> Parsed<&'a [u8]> {
        let end = self.at.checked_add(n).ok_or("a length beyond its end")?;
        let part = self.bytes.get(self.at..end).ok_or("it ends in the middle")?;
        self.at = end;
        Ok(part)
    }

    fn array<const N: usize>(&mut self) -> Parsed<[u8; N]> {
        self.take(N)?.try_into().map_err(|_| "it ends in the middle".into())
    }

    fn u8(&mut self) -> Parsed<u8> {
        Ok(self.array::<1>()?[0])
    }

    /// A length of `n` bytes, little-endian.
    fn len(&mut self, n: usize) -> Parsed<usize> {
        let mut whole = [0; 8];
        whole[..n].copy_from_slice(self.take(n)?);
        usize::try_from(u64::from_le_bytes(whole)).map_err(|_| "a length beyond its end".into())
    }

    fn number(&mut self, n: usize) -> Parsed<()> {
        let number = self.len(n)?;
        self.push(Value::Int(number as i64))
    }

    /// An integer of any length, two's complement.
    fn long(&mut self) -> Parsed<()> {
        let n = self.len(1)?;
        let bytes = self.take(n)?;
        if n > 8 {
            return self.push(Value::Opaque);
        }
        let negative = bytes.last().is_some_and(|b| *b >= 0x80);
        let mut whole = [if negative { 0xff } else { 0 }; 8];
        whole[..n].copy_from_slice(bytes);
        self.push(Value::Int(i64::from_le_bytes(whole)))
    }

    fn text(&mut self, n: usize) -> Parsed<()> {
        let len = self.len(n)?;
        let text = core::str::from_utf8(self.take(len)?).map_err(|e| format!("a text is damaged: {e}"))?;
        self.push(Value::Text(text))
    }

    fn line(&mut self) -> Parsed<&'a str> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let len = rest.iter().position(|b| *b == b'\n').ok_or("it ends in the middle of a name")?;
        let line = core::str::from_utf8(self.take(len)?).map_err(|e| format!("a name is damaged: {e}"))?;
        self.take(1)?;
        Ok(line)
    }

    fn push(&mut self, value: Value<'a>) -> Parsed<()> {
        if self.values.len() >= MAX_VALUES {
            return Err(format!("it makes more than {MAX_VALUES} values"));
        }
        self.stack.push(self.values.len() as Id);
        self.values.push(value);
        Ok(())
    }

    /// The height of the stack without its upper `n`, which lie above the last mark.
    fn height(&self, n: usize) -> Parsed<usize> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let at = self.stack.len().checked_sub(n).filter(|at| *at >= floor);
        at.ok_or_else(|| "it takes more from the stack than there is".into())
    }

    fn pop(&mut self) -> Parsed<Id> {
        let at = self.height(1)?;
        let id = self.stack.get(at).copied().ok_or("the stack is empty")?;
        self.stack.truncate(at);
        Ok(id)
    }

    fn top(&self) -> Parsed<Id> {
        let at = self.height(1)?;
        self.stack.get(at).copied().ok_or_else(|| "the stack is empty".into())
    }

    fn since_mark(&mut self) -> Parsed<Vec<Id>> {
        let at = self.marks.pop().ok_or("a mark is missing")?;
        if at > self.stack.len() {
            return Err("a mark lies above the stack".into());
        }
        Ok(self.stack.split_off(at))
    }

    fn value(&self, id: Id) -> &Value<'a> {
        self.values.get(id as usize).unwrap_or(&Value::None)
    }

    fn pop_text(&mut self) -> Parsed<&'a str> {
        let id = self.pop()?;
        match self.value(id) {
            Value::Text(text) => Ok(text),
            other => Err(format!("a name is {}", other.kind())),
        }
    }

    fn pop_tuple(&mut self) -> Parsed<Vec<Id>> {
        let id = self.pop()?;
        match self.value(id) {
            Value::Tuple(items) => Ok(items.clone()),
            other => Err(format!("arguments are {}", other.kind())),
        }
    }

    fn append(&mut self, mut items: Vec<Id>) -> Parsed<()> {
        let list = self.top()?;
        match self.values.get_mut(list as usize) {
            Some(Value::List(list)) => list.append(&mut items),
            _ => return Err("something is appended to a value that is not a list".into()),
        }
        Ok(())
    }

    fn set_items(&mut self, items: &[Id]) -> Parsed<()> {
        let (pairs, rest) = items.as_chunks::<2>();
        if !rest.is_empty() {
            return Err("a dict has a key without a value".into());
        }
        let dict = self.top()?;
        match self.values.get_mut(dict as usize) {
            Some(Value::Dict(dict)) => dict.extend(pairs.iter().map(|[key, value]| (*key, *value))),
            _ => return Err("something is set in a value that is not a dict".into()),
        }
        Ok(())
    }

    fn remember(&mut self, n: usize) -> Parsed<()> {
        let place = self.len(n)? as u32;
        let top = self.top()?;
        self.memo.insert(place, top);
        Ok(())
    }

    fn recall(&mut self, n: usize) -> Parsed<()> {
        let place = self.len(n)? as u32;
        let id = *self.memo.get(&place).ok_or("it refers to what it never said")?;
        if self.stack.len() >= MAX_VALUES {
            return Err(format!("it holds more than {MAX_VALUES} values"));
        }
        self.stack.push(id);
        Ok(())
    }

    fn global(&mut self, module: &str, name: &str) -> Parsed<()> {
        self.push(Value::Global(known_global(module, name)?))
    }

    /// A storage: `("storage", type, key, device, length)`.
    fn persistent(&mut self) -> Parsed<()> {
        let items = self.pop_tuple()?;
        let values: Vec<_> = items.iter().map(|id| self.value(*id)).collect();
        let storage = match values.as_slice() {
            [
                Value::Text("storage"),
                Value::Global(Global::Storage(element)),
                Value::Text(key),
                _device,
                Value::Int(len),
                ..,
            ] => Storage { element: *element, key, len: u64::try_from(*len).map_err(|e| e.to_string())? },
            _ => return Err("it refers to an external object that is not a storage of numbers".into()),
        };
        self.push(Value::Storage(storage))
    }

    fn call(&mut self) -> Parsed<()> {
        let arguments = self.pop_tuple()?;
        let function = self.pop()?;
        let Value::Global(function) = *self.value(function) else {
            return Err("it calls a value that is not a function".into());
        };
        let first = arguments.first().map(|id| self.value(*id).clone());
        let value = match (function, first) {
            (Global::OrderedDict, None) => Value::Dict(Vec::new()),
            (Global::Size, Some(tuple @ Value::Tuple(_))) => tuple,
            (Global::RebuildParameter, Some(tensor @ Value::Tensor(_))) => tensor,
            (Global::RebuildTensor, Some(Value::Storage(storage))) => self.tensor(storage, &arguments)?,
            _ => return Err(format!("{function:?} is called with what it does not take")),
        };
        self.push(value)
    }

    fn tensor(&self, storage: Storage<'a>, arguments: &[Id]) -> Parsed<Value<'a>> {
        let [_, offset, shape, strides, ..] = arguments else {
            return Err("a tensor lacks its shape".into());
        };
        let Value::Int(offset) = *self.value(*offset) else {
            return Err("the offset of a tensor is not a number".into());
        };
        let offset = u64::try_from(offset).map_err(|_| "a tensor begins before its storage")?;
        let shape = self.sizes(*shape)?;
        let strides = self.sizes(*strides)?;
        if shape.len() != strides.len() {
            return Err("a tensor has more dimensions than strides, or fewer".into());
        }
        let shape = shape.into_iter().map(|n| n as usize).collect();
        Ok(Value::Tensor(Tensor { storage, offset, shape, strides }))
    }

    fn sizes(&self, id: Id) -> Parsed<Vec<u64>> {
        let Value::Tuple(items) = self.value(id) else {
            return Err("the shape of a tensor is not a tuple".into());
        };
        if items.len() > MAX_DIMENSIONS {
            return Err(format!("a tensor has {} dimensions", items.len()));
        }
        let size = |id: &Id| match self.value(*id) {
            Value::Int(n) => u64::try_from(*n).map_err(|_| "a size is below 0".to_owned()),
            other => Err(format!("a size is {}", other.kind())),
        };
        items.iter().map(size).collect()
    }
}

/// The function or class, if it is one of those that state dicts need.
fn known_global(module: &str, name: &str) -> Parsed<Global> {
    use Element::{Float, Other};
    Ok(match (module, name) {
        ("collections", "OrderedDict") => Global::OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2") => Global::RebuildTensor,
        ("torch._utils", "_rebuild_parameter") => Global::RebuildParameter,
        ("torch", "Size") => Global::Size,
        ("torch", "FloatStorage") => Global::Storage(Float(Dtype::F32)),
        ("torch", "HalfStorage") => Global::Storage(Float(Dtype::F16)),
        ("torch", "BFloat16Storage") => Global::Storage(Float(Dtype::Bf16)),
        ("torch", "DoubleStorage") => Global::Storage(Float(Dtype::F64)),
        ("torch", "LongStorage") => Global::Storage(Other("int64")),
        ("torch", "IntStorage") => Global::Storage(Other("int32")),
        ("torch", "ShortStorage") => Global::Storage(Other("int16")),
        ("torch", "CharStorage") => Global::Storage(Other("int8")),
        ("torch", "ByteStorage") => Global::Storage(Other("uint8")),
        ("torch", "BoolStorage") => Global::Storage(Other("bool")),
        ("torch", "float32" | "float16" | "bfloat16" | "float64" | "int64" | "int32" | "bool") => {
            Global::Dtype
        }
        _ => {
            let what: String = format!("{module}.{name}").chars().take(120).collect();
            return Err(format!(
                "it names {what:?}, which no state dict needs; nothing is run here. If you trust the file, \
                 write its weights alone: torch.save({{\"model\": torch.load(FILE, weights_only=False)[\"model\"]}}, NEW)"
            ));
        }
    })
}

fn unknown(op: u8) -> String {
    if op.is_ascii_graphic() {
        format!("operation {:?} is not allowed in a state dict", char::from(op))
    } else {
        format!("operation {op:#04x} is not allowed in a state dict")
    }
}
