//! Request checks that keep web pages and other strangers out.

use super::reply::Refusal;
use axum::extract::Request;
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Refuses requests that name another host than this one: a web page whose name was made to point here
/// still sends its own name.
pub(super) async fn loopback_host(request: Request, next: Next) -> Response {
    let mut hosts = request.headers().get_all(header::HOST).iter();
    let host = hosts.next().and_then(|h| h.to_str().ok());
    if let (Some(host), None) = (host, hosts.next())
        && is_loopback(host)
    {
        return next.run(request).await;
    }
    let host = host.unwrap_or_default();
    let message = format!("Host \"{host}\" is not a loopback name; use localhost, 127.0.0.1 or [::1]");
    Refusal::new(StatusCode::FORBIDDEN, message).into_response()
}

/// Refuses requests of a page that another server sent: a browser names it with each WebSocket and each POST, and programs that are no browsers name none.
pub(super) async fn own_origin(request: Request, next: Next) -> Response {
    let headers = request.headers();
    let own = headers.get(header::HOST).map(|host| [b"http://", host.as_bytes()].concat());
    let foreign = headers.get(header::ORIGIN).filter(|o| own.as_deref() != Some(o.as_bytes())).cloned();
    let Some(origin) = foreign else { return next.run(request).await };
    let message = format!("a page of {} may not use this rig", String::from_utf8_lossy(origin.as_bytes()));
    Refusal::denied(StatusCode::FORBIDDEN, message).into_response()
}

/// Refuses a POST that is not JSON, which a web page of another origin could send without being asked.
pub(super) async fn json_posts(request: Request, next: Next) -> Response {
    let content_type =
        request.headers().get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let essence = content_type.split(';').next().unwrap_or_default().trim();
    if request.method() == Method::POST && !essence.eq_ignore_ascii_case("application/json") {
        let message =
            format!("a POST must have the header Content-Type: application/json, not \"{content_type}\"");
        return Refusal::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, message).into_response();
    }
    next.run(request).await
}

/// Whether `host`, a name or an address with or without a port, is this computer and nothing else.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) && !name.ends_with(':') => name,
        _ => host,
    };
    let name = name.strip_prefix('[').and_then(|n| n.strip_suffix(']')).unwrap_or(name);
    name.eq_ignore_ascii_case("localhost") || name.parse::<std::net::IpAddr>().is_ok_and(|a| a.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_computer_is_loopback() {
        for good in ["localhost", "LOCALHOST:80", "127.0.0.1", "127.1.2.3:8642", "[::1]", "[::1]:80", "::1"] {
            assert!(is_loopback(good), "{good}");
        }
        for bad in [
            "",
            "evil.example",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "192.168.0.7:80",
            "0.0.0.0",
            "[::]:80",
            "localhost:80:80",
            "evil.example:127",
            "127.0.0.1@evil.example",
            "[::1",
            "localhost ",
        ] {
            assert!(!is_loopback(bad), "{bad}");
        }
    }
}
