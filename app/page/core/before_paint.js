/** Runs before the first paint: what it sets would otherwise move or recolour the page while it starts. */

{
  const root = document.documentElement;
  const theme = localStorage.getItem('beliefscope.theme');
  if (theme === 'light' || theme === 'dark') root.dataset.theme = theme;
  const isClosed = localStorage.getItem('beliefscope.intro') === 'closed';
  root.classList.toggle('first-visit', !location.search && !isClosed);
  // A part of the header would be centred until the rest has arrived.
  root.classList.add('incomplete');
  document.addEventListener('readystatechange', () => root.classList.remove('incomplete'));
  try {
    const sizes = JSON.parse(localStorage.getItem('beliefscope.sizes') ?? '{}');
    for (const [name, share] of Object.entries(sizes))
      if (/^[a-z]+$/.test(name) && Number.isFinite(share)) {
        root.style.setProperty(`--${name}-share`, String(share));
        root.classList.add(`sized-${name}`);
      }
  } catch {
    localStorage.removeItem('beliefscope.sizes');
  }
}
