//! An XML file as a tree of elements with their lines.
//!
//! The elements stand in one list, in the order of the file: nothing here recurses, however deep a file nests. Files
//! with a DTD are refused, so there are no entities to expand.

use quick_xml::XmlVersion;
use quick_xml::events::{BytesStart, Event};
use quick_xml::reader::Reader;

#[derive(Debug)]
struct Element {
    name: String,
    attributes: Vec<(String, String)>,
    /// The text right below it; references in it are left out, as no value that is read has any.
    text: String,
    line: usize,
    /// The place behind its last descendant.
    end: usize,
}

/// A file's elements.
#[derive(Debug)]
pub(super) struct Tree {
    elements: Vec<Element>,
}

/// What is wrong with a file, and in which line.
#[derive(Debug)]
pub(super) struct XmlError {
    pub(super) message: String,
    pub(super) line: usize,
}

impl Tree {
    pub(super) fn parse(text: &str) -> Result<Self, XmlError> {
        let mut reader = Reader::from_str(text);
        let mut elements: Vec<Element> = Vec::new();
        let mut open: Vec<usize> = Vec::new();
        // Lines are counted as far as the reader has come.
        let (mut line, mut counted) = (1, 0);
        let mut line_at = |position: u64| {
            let position = text.floor_char_boundary(position as usize).max(counted);
            line += text[counted..position].matches('\n').count();
            counted = position;
            line
        };
        loop {
            let begin = line_at(reader.buffer_position());
            let fail = |message: String| XmlError {
                message,
                line: begin,
            };
            let event = reader.read_event().map_err(|error| XmlError {
                message: error.to_string(),
                line: line_at(reader.error_position()),
            })?;
            match event {
                Event::Start(start) => {
                    open.push(elements.len());
                    elements.push(element(&start, begin).map_err(fail)?);
                }
                Event::Empty(start) => {
                    let place = elements.len();
                    elements.push(element(&start, begin).map_err(fail)?);
                    elements[place].end = place + 1;
                }
                Event::End(_) => {
                    if let Some(place) = open.pop() {
                        elements[place].end = elements.len();
                    }
                }
                Event::Text(part) => {
                    if let Some(&place) = open.last() {
                        let part = part.decode().map_err(|error| fail(error.to_string()))?;
                        elements[place].text.push_str(&part);
                    }
                }
                Event::DocType(_) => {
                    return Err(fail("a document type is not supported".into()));
                }
                Event::Eof if !open.is_empty() => {
                    return Err(fail("the file ends inside an element".into()));
                }
                Event::Eof => return Ok(Self { elements }),
                Event::CData(_)
                | Event::Comment(_)
                | Event::Decl(_)
                | Event::PI(_)
                | Event::GeneralRef(_) => {}
            }
        }
    }

    /// All elements, in the order of the file.
    pub(super) fn nodes(&self) -> impl Iterator<Item = Node<'_>> {
        (0..self.elements.len()).map(|place| Node { tree: self, place })
    }
}

fn element(start: &BytesStart<'_>, line: usize) -> Result<Element, String> {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let attributes = start
        .attributes()
        .map(|attribute| {
            let attribute = attribute.map_err(|error| error.to_string())?;
            let value = attribute
                .normalized_value(XmlVersion::Implicit1_0)
                .map_err(|error| error.to_string())?;
            Ok((text(attribute.key.as_ref()), value.into_owned()))
        })
        .collect::<Result<_, String>>()?;
    Ok(Element {
        name: text(start.name().as_ref()),
        attributes,
        text: String::new(),
        line,
        end: 0,
    })
}

/// An element of a [`Tree`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Node<'a> {
    tree: &'a Tree,
    place: usize,
}

impl<'a> Node<'a> {
    fn element(self) -> &'a Element {
        &self.tree.elements[self.place]
    }

    pub(super) fn name(self) -> &'a str {
        &self.element().name
    }

    pub(super) fn text(self) -> &'a str {
        &self.element().text
    }

    pub(super) fn line(self) -> usize {
        self.element().line
    }

    pub(super) fn attribute(self, name: &str) -> Option<&'a str> {
        let mut attributes = self.element().attributes.iter();
        attributes
            .find(|(known, _)| known == name)
            .map(|(_, value)| value.as_str())
    }

    /// The elements right below it with this name.
    pub(super) fn children(self, name: &'static str) -> impl Iterator<Item = Self> {
        let mut next = self.place + 1;
        std::iter::from_fn(move || {
            (next < self.element().end).then(|| {
                let child = Self {
                    place: next,
                    ..self
                };
                next = child.element().end;
                child
            })
        })
        .filter(move |child| child.name() == name)
    }

    pub(super) fn child(self, name: &'static str) -> Option<Self> {
        self.children(name).next()
    }

    /// All elements below it with this name.
    pub(super) fn descendants(self, name: &'static str) -> impl Iterator<Item = Self> {
        (self.place + 1..self.element().end)
            .map(move |place| Self { place, ..self })
            .filter(move |node| node.name() == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_have_their_place() {
        let tree = Tree::parse(
            "<?xml version=\"1.0\"?>\n<a>\n <b x=\"1 &amp; 2\"> 7 <c/>8</b>\n<b><c>\n</c></b></a>",
        )
        .expect("a tree");
        let root = tree.nodes().next().expect("the root");
        let lines: Vec<usize> = root.children("b").map(Node::line).collect();
        assert_eq!(lines, [3, 4]);
        let first = root.child("b").expect("a child");
        assert_eq!(
            (first.attribute("x"), first.text()),
            (Some("1 & 2"), " 7 8")
        );
        assert_eq!(
            (root.children("c").count(), root.descendants("c").count()),
            (0, 2)
        );
    }

    #[test]
    fn unsound_files_are_refused_with_their_line() {
        for (text, line) in [
            ("<a>\n</b>", 2),
            ("<a>\n\n", 3),
            ("<a>\n<b x=\"&c;\"/></a>", 2),
            ("<!DOCTYPE a>\n<a/>", 1),
            ("<a>\n<b x=\"1\" x=\"2\"/></a>", 2),
        ] {
            let error = Tree::parse(text).expect_err(text);
            assert_eq!(error.line, line, "{text}: {}", error.message);
        }
    }
}
