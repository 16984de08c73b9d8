//! Errors as the API returns them: a fitting HTTP status and `{"error": {"kind", "message"}}`.

use crate::{Error, ErrorKind};
use axum::Json;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

/// Every kind with its name and status. Names are part of the API.
const KINDS: [(ErrorKind, &str, StatusCode); 8] = [
    (ErrorKind::BadInput, "bad_input", StatusCode::BAD_REQUEST),
    (ErrorKind::NotFound, "not_found", StatusCode::NOT_FOUND),
    (ErrorKind::InUse, "in_use", StatusCode::CONFLICT),
    (ErrorKind::WrongState, "wrong_state", StatusCode::CONFLICT),
    (ErrorKind::NoSpace, "no_space", StatusCode::INSUFFICIENT_STORAGE),
    (ErrorKind::PermissionDenied, "permission_denied", StatusCode::FORBIDDEN),
    (ErrorKind::Unreachable, "unreachable", StatusCode::SERVICE_UNAVAILABLE),
    (ErrorKind::Other, "other", StatusCode::INTERNAL_SERVER_ERROR),
];

/// The body of an error answer.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct ErrorBody {
    pub(crate) error: ErrorDetail,
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct ErrorDetail {
    pub(crate) kind: String,
    pub(crate) message: String,
}

/// The kind that the API calls `name`; later versions may know more.
pub(crate) fn kind_of_name(name: &str) -> ErrorKind {
    KINDS.iter().find(|(_, n, _)| *n == name).map_or(ErrorKind::Other, |(kind, ..)| *kind)
}

/// An error answer.
#[derive(Debug)]
pub(super) struct Refusal {
    status: StatusCode,
    kind: &'static str,
    message: String,
}

impl Refusal {
    /// A request that is itself wrong.
    pub(super) fn new(status: StatusCode, message: impl Into<String>) -> Self {
        let named = KINDS.iter().find(|(_, _, s)| *s == status);
        let kind = named.map_or("bad_input", |(_, name, _)| name);
        Self { status, kind, message: message.into() }
    }

    /// Who asks may not.
    pub(super) fn denied(status: StatusCode, message: impl Into<String>) -> Self {
        Self { status, kind: "permission_denied", message: message.into() }
    }
}

impl From<Error> for Refusal {
    fn from(e: Error) -> Self {
        let known = KINDS.iter().find(|(kind, ..)| *kind == e.kind());
        let (kind, status) = known.map_or(("other", StatusCode::INTERNAL_SERVER_ERROR), |(_, n, s)| (*n, *s));
        Self { status, kind, message: e.to_string() }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let error = ErrorDetail { kind: self.kind.to_owned(), message: self.message };
        (self.status, Json(ErrorBody { error })).into_response()
    }
}
