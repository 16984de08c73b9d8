//! A drawing as SVG and as PDF, at true scale.

use super::draw::Drawing;
use core::fmt::Write as _;
use pdf_writer::{Content, Name, Pdf, Rect, Ref, Str};

/// Points of PDF in a millimetre.
const POINTS: f64 = 72.0 / 25.4;
/// Height of the text, millimetres.
const TEXT_MM: f64 = 2.8;

impl Drawing {
    /// As SVG, in millimetres.
    pub fn to_svg(&self) -> String {
        let paper = self.paper;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}mm\" height=\"{h}mm\" viewBox=\"0 0 {w} {h}\">\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"#fff\"/>\n<path shape-rendering=\"crispEdges\" d=\"",
            w = paper.width_mm,
            h = paper.height_mm
        );
        for r in &self.black {
            // Formatting into a string does not fail.
            let _ = writeln!(svg, "M{:.4} {:.4}h{:.4}v{:.4}h{:.4}z", r.x, r.y, r.width, r.height, -r.width);
        }
        svg.push_str("\"/>\n");
        for label in &self.labels {
            let _ = writeln!(
                svg,
                "<text x=\"{:.3}\" y=\"{:.3}\" font-family=\"sans-serif\" font-size=\"{TEXT_MM}\">{}</text>",
                label.x, label.y, label.text
            );
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// As PDF of one page.
    pub fn to_pdf(&self) -> Vec<u8> {
        let catalog = Ref::new(1);
        let pages = Ref::new(2);
        let page = Ref::new(3);
        let font = Ref::new(4);
        let content = Ref::new(5);
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages);
        pdf.pages(pages).kids([page]).count(1);
        {
            let mut of = pdf.page(page);
            of.parent(pages)
                .media_box(Rect::new(0.0, 0.0, points(self.paper.width_mm), points(self.paper.height_mm)))
                .contents(content);
            of.resources().fonts().pair(Name(b"F"), font);
        }
        pdf.type1_font(font).base_font(Name(b"Helvetica"));
        let mut stream = Content::new();
        // PDF counts from the bottom.
        let up = |y: f64| points(self.paper.height_mm - y);
        for r in &self.black {
            stream.rect(points(r.x), up(r.y + r.height), points(r.width), points(r.height));
        }
        stream.fill_nonzero();
        for label in &self.labels {
            stream
                .begin_text()
                .set_font(Name(b"F"), points(TEXT_MM))
                .next_line(points(label.x), up(label.y))
                .show(Str(label.text.as_bytes()))
                .end_text();
        }
        pdf.stream(content, &stream.finish());
        pdf.finish()
    }
}

fn points(mm: f64) -> f32 {
    (mm * POINTS) as f32
}
