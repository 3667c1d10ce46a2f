// A script that runs where modules do not: says why the page does not start. Its syntax is old on purpose.
(function () {
  "use strict";
  var NEEDED = " The host must have all files of this page, and send .js files as JavaScript"
    + " (Content-Type: text/javascript).";

  function tell(reason) {
    document.body.setAttribute("data-state", "failed");
    document.getElementById("message").textContent = "This page cannot start: " + reason;
    document.getElementById("again").hidden = false;
    document.getElementById("again").onclick = function () { location.reload(); };
  }

  /** Return a promise of what is wrong with the reply to a module's address; of nothing if it is right. */
  function faultOf(element) {
    var address = element.src || element.href;
    return fetch(address).then(function (reply) {
      var type = reply.headers.get("Content-Type") || "a file of no type";
      if (!reply.ok) return "the host answers " + reply.status + " for " + address + ".";
      return /javascript|ecmascript/i.test(type) ? "" : "the host sends " + address + " as " + type + ".";
    }, function () { return "the host does not answer for " + address + "."; });
  }

  function explain() {
    if (location.protocol === "file:") {
      tell("browsers load no modules from files. Open it through a web server, such as python -m http.server.");
      return;
    }
    var modules = document.querySelectorAll("script[type=module], link[rel=modulepreload]");
    Promise.all([].map.call(modules, faultOf)).then(function (faults) {
      tell((faults.filter(Boolean)[0] || "a module that it imports could not be loaded.") + NEEDED);
    });
  }

  document.documentElement.className = "scripted"; // hides what is said where no script runs
  window.addEventListener("error", function (event) {
    if (event.target.tagName === "SCRIPT") explain();
    else if (event.error instanceof SyntaxError) tell(event.filename + ": " + event.message);
  }, true);
  if (!("noModule" in HTMLScriptElement.prototype)) {
    document.addEventListener("DOMContentLoaded", function () {
      tell("this browser loads no JavaScript modules. Use a newer one.");
    });
  }
})();
